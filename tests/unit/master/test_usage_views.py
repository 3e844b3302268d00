"""The usage of machines with many containers is added up in pieces."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any, cast

from rce.control.messages import MachineInfo, Usage
from rce.control.model import EndpointUsage
from rce_master.http.usage_views import UsageViews
from rce_master.state.placement import Room
from rce_master.usage import UsageBook

if TYPE_CHECKING:
    from collections.abc import Iterable

CONTAINERS = [f"anna/c{number}" for number in range(2000)]


class Endpoints:
    """All containers, on one machine."""

    def keys(self, index: str, value: str) -> Iterable[str]:
        assert index == "task_set"
        return CONTAINERS if value == "c1" else []


class Tables:
    """The used part of the tables: two machines."""

    endpoints = Endpoints()
    rooms = tuple(Room(process=f"c{number}", machine=MachineInfo(name=f"m{number}")) for number in (1, 2))

    def is_connected(self, process: str) -> bool:
        return process == "c1"


async def test_others_have_their_turns_while_usage_is_added_up() -> None:
    book = UsageBook(lambda: 1.0)
    usage = Usage(cpu_s=0.0, memory=0, endpoints={id_: EndpointUsage(memory=3) for id_ in CONTAINERS})
    book.note("c1", usage, CONTAINERS)
    views = UsageViews(cast("Any", Tables()), book)
    making = asyncio.create_task(views.machines())
    turns = 0
    while not making.done():
        await asyncio.sleep(0)
        turns += 1
    first, second = making.result()
    assert (first.memory_used, second.memory_used) == (3 * len(CONTAINERS), 0)
    assert (first.connected, second.connected) == (True, False)
    assert turns >= 10
