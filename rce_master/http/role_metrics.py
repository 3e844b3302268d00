"""Metrics of which of several masters leads; a stand-by has no others."""

from __future__ import annotations

from typing import TYPE_CHECKING

from aiohttp import web
from prometheus_client import CONTENT_TYPE_LATEST, CollectorRegistry, generate_latest
from prometheus_client.core import GaugeMetricFamily
from prometheus_client.registry import Collector

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from prometheus_client.metrics_core import Metric


class RoleCollector(Collector):
    """Whether this master leads, and the term.

    Args:
        leads: Whether this master leads.
        term: Returns the newest term that this master knows; 0: none.
    """

    def __init__(self, term: Callable[[], int], *, leads: bool) -> None:
        self._leads = leads
        self._term = term

    def collect(self) -> Iterator[Metric]:
        """Make all metrics."""
        yield GaugeMetricFamily("rce_master_leading", "1 if this master leads.", value=float(self._leads))
        yield GaugeMetricFamily("rce_master_term", "The newest term that it knows.", value=self._term())


def standby_answer(term: Callable[[], int]) -> Callable[[], web.Response]:
    """Return the function that answers a scrape of a stand-by.

    Args:
        term: Returns the newest term that the stand-by knows; 0: none.
    """
    registry = CollectorRegistry()
    registry.register(RoleCollector(term, leads=False))
    headers = {"Content-Type": CONTENT_TYPE_LATEST}
    return lambda: web.Response(body=generate_latest(registry), headers=headers)
