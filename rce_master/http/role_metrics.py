"""Metrics of which of several masters leads; a stand-by has no others."""

from __future__ import annotations

from typing import TYPE_CHECKING

from aiohttp import web
from prometheus_client import CONTENT_TYPE_LATEST, CollectorRegistry, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily
from prometheus_client.registry import Collector

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from prometheus_client.metrics_core import Metric

    from rce_master.follower import StateFollower


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


class LagCollector(Collector):
    """How far a stand-by's copy of the state is behind.

    Args:
        follower: Keeps the copy.
    """

    def __init__(self, follower: StateFollower) -> None:
        self._follower = follower

    def collect(self) -> Iterator[Metric]:
        """Make all metrics."""
        follower = self._follower
        yield GaugeMetricFamily(
            "rce_master_lag_seconds",
            "For how long the copy of the state is behind; 0: it is not.",
            value=follower.seconds_behind,
        )
        yield GaugeMetricFamily(
            "rce_master_lag_revisions", "Revisions of etcd that it is behind.", value=follower.lag.revisions
        )
        yield CounterMetricFamily(
            "rce_master_state_loads", "How often the whole state was loaded.", value=follower.loads
        )


def standby_answer(term: Callable[[], int], follower: StateFollower) -> Callable[[], web.Response]:
    """Return the function that answers a scrape of a stand-by.

    Args:
        term: Returns the newest term that the stand-by knows; 0: none.
        follower: Follows the state.
    """
    registry = CollectorRegistry()
    registry.register(RoleCollector(term, leads=False))
    registry.register(LagCollector(follower))
    headers = {"Content-Type": CONTENT_TYPE_LATEST}
    return lambda: web.Response(body=generate_latest(registry), headers=headers)
