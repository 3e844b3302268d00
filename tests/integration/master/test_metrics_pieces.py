"""``/metrics`` of many containers: made and written in pieces, so that no step of the event loop is long."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import pytest
from prometheus_client.parser import text_string_to_metric_families

from rce_master.http import metrics_pieces

if TYPE_CHECKING:
    from integration.master.conftest import Site
    from prometheus_client.metrics_core import Metric

CONTAINERS = 12
PIECE = 20


def series(text: str) -> list[str]:
    """Return the lines of series of endpoints."""
    return [line for line in text.splitlines() if line.startswith(("rce_container_", "rce_node_"))]


def totals(text: str) -> list[str]:
    """Return the lines that count what the engine has."""
    counted = ("rce_containers{", "rce_nodes{", "rce_robots{", "rce_connections{", "rce_users ")
    return [line for line in text.splitlines() if line.startswith(counted)]


async def scrape(site: Site) -> str:
    async with site.session.get(f"{site.url}metrics") as reply:
        assert reply.status == 200
        return await reply.text()


async def test_metrics_are_the_same_in_pieces(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    """However small the pieces are, each series is listed once, and each metric is described once."""
    for number in range(CONTAINERS):
        await site.api("POST", "/containers", {"tag": f"c{number}"}, status=204)
    whole = await scrape(site)
    sizes: list[int] = []
    write = metrics_pieces.write_pieces

    def counted(metric: Metric) -> list[bytes]:
        pieces = list(write(metric))
        sizes.extend(len(series(piece.decode())) for piece in pieces)
        return pieces

    monkeypatch.setattr(metrics_pieces, "PIECE", PIECE)
    for module in ("metrics", "engine_metrics"):
        monkeypatch.setattr(f"rce_master.http.{module}.write_pieces", counted)
    parts = await scrape(site)
    assert series(parts) == series(whole)
    assert totals(parts) == totals(whole)
    assert f'rce_containers{{state="requested"}} {CONTAINERS}.0' in totals(whole)
    assert len(series(parts)) >= 10 * CONTAINERS
    assert 0 < max(sizes) <= PIECE
    names = [family.name for family in text_string_to_metric_families(parts)]
    assert len(names) == len(set(names))
    assert parts.count("# TYPE rce_container_memory_bytes gauge") == 1


async def test_containers_can_go_while_metrics_are_made(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    """A container that is removed between two pieces is not listed, and nothing fails."""
    for number in range(CONTAINERS):
        await site.api("POST", "/containers", {"tag": f"c{number}"}, status=204)
    monkeypatch.setattr(metrics_pieces, "PIECE", 1)
    async with asyncio.TaskGroup() as group:
        scrapes = [group.create_task(scrape(site)) for _ in range(3)]
        for number in range(CONTAINERS):
            group.create_task(site.api("DELETE", f"/containers/c{number}", status=204))
    assert all("rce_metrics_omitted 0.0" in done.result() for done in scrapes)
    assert series(await scrape(site)) == []
