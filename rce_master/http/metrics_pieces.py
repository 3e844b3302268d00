"""Metrics of a large engine are made and written in pieces, between which the event loop has its turn."""

from __future__ import annotations

import asyncio
from copy import copy
from typing import TYPE_CHECKING, NamedTuple, TypeVar

from prometheus_client import generate_latest

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterator

    from prometheus_client.metrics_core import Metric

    from rce_master.state.table import Table

R = TypeVar("R")

PIECE = 250
"""Series that are made or written, or records that are counted, between two turns of the event loop."""


async def in_pieces(table: Table[R]) -> AsyncIterator[R]:
    """Yield a table's records; after each :data:`PIECE` other tasks run, and may remove or change some."""
    for number, key in enumerate([table.key(record) for record in table], 1):
        record = table.get(key)
        if record is not None:
            yield record
        if number % PIECE == 0:
            await asyncio.sleep(0)


class _Piece(NamedTuple):
    """A part of a metric, in place of a registry."""

    metric: Metric

    def collect(self) -> tuple[Metric]:
        """Return the part."""
        return (self.metric,)


def write_pieces(metric: Metric) -> Iterator[bytes]:
    """Write a metric, at most :data:`PIECE` series at a time, with its description before the first ones."""
    for begin in range(0, max(len(metric.samples), 1), PIECE):
        part = copy(metric)
        part.samples = metric.samples[begin : begin + PIECE]
        text = generate_latest(_Piece(part))
        lines = text.splitlines(keepends=True)
        yield text if begin == 0 else b"".join(line for line in lines if not line.startswith(b"#"))
