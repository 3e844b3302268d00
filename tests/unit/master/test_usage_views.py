"""The usage of machines with many containers is added up in pieces."""

from __future__ import annotations

import asyncio
import io
from typing import TYPE_CHECKING, Any, cast

from rich.console import Console
from support.master_world import World

from rce.control.messages import MachineInfo, Usage
from rce.control.model import EndpointUsage
from rce.model.specs import Network
from rce_master.cli import top
from rce_master.http.usage_views import UsageViews
from rce_master.state import commands
from rce_master.state.placement import Room
from rce_master.usage import UsageBook

if TYPE_CHECKING:
    from collections.abc import Iterable

MB = 1 << 20
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


async def test_a_machine_that_is_too_full_names_a_container_to_move() -> None:
    """One that runs, moves alone, and is not moving already."""
    world = World()
    world.container_set("c1", name="m1", memory=1000 * MB, networks=("group",))
    for tag in ("a_moving", "a_grouped", "a_starts", "b", "c"):
        network = Network.GROUP if tag == "a_grouped" else Network.NONE
        world.container(tag, memory=190 * MB, network=network, group="g" if tag == "a_grouped" else "")
        if tag != "a_starts":
            world.run(tag)
    world.container_set("c2", name="m2", memory=1000 * MB)
    world.do(commands.MoveContainer(user="anna", tag="a_moving", machine="m2"))
    views = UsageViews(world.state.tables, UsageBook(lambda: 1.0))
    first, second = await views.machines()
    assert [advice.command for advice in first.advice] == ["rce move b m2 --user anna"]
    assert second.advice == []


def crowded() -> tuple[World, UsageBook]:
    """Return a full machine with a container short of memory; the fullest of three others has its label."""
    world = World()
    world.container_set("c1", name="m1", memory=300 * MB, labels=("gpu",))
    world.container("c", memory=290 * MB, special_features=("gpu",))
    world.run("c")
    for number in (2, 3):
        world.container_set(f"c{number}", name=f"m{number}", memory=1000 * MB)
    world.container_set("c4", name="m4", memory=2000 * MB, labels=("gpu",))
    world.container("d", memory=600 * MB, special_features=("gpu",))
    used = EndpointUsage(memory=280 * MB, memory_limit=290 * MB)
    book = UsageBook(lambda: 1.0)
    book.note("c1", Usage(cpu_s=0.0, memory=0, endpoints={"anna/c": used}), ["anna/c"])
    return world, book


async def test_advice_on_containers_of_others_names_their_user() -> None:
    """Both a move and what follows it do; machines that are emptier but lack the label are passed over."""
    world, book = crowded()
    tables = world.state.tables
    container = tables.container("anna/c")
    assert container is not None

    async def shown(reader: str) -> str:
        views = UsageViews(tables, book, reader)
        usage = {
            "containers": [views.container(container).model_dump()],
            "machines": [one.model_dump() for one in await views.machines()],
        }
        console = Console(file=io.StringIO(), width=250)
        console.print(top.layout(usage, top.Look(top.Order.CPU)))
        assert isinstance(console.file, io.StringIO)
        return console.file.getvalue()

    resize = "resize c --memory 448M"
    assert f"rce move c m4 --wait --user anna && rce {resize} --user anna" in await shown("root")
    own = await shown("anna")
    assert f"rce move c m4 --wait && rce {resize}\n" in own
    assert "rce move c m4 --user anna" in own, "advice on the machine, which is too full"
