"""Builds the API's answers about usage."""

from __future__ import annotations

import asyncio
from functools import cached_property
from typing import TYPE_CHECKING

from rce.control import EndpointUsage, NodeStatus, NodeUsage
from rce.model import Network
from rce_master import advice
from rce_master.http import usage_models as models
from rce_master.state.lifecycle import ContainerPhase
from rce_master.state.records import Container
from rce_master.usage import NO_RATES, History, UsageBook

if TYPE_CHECKING:
    from collections.abc import Iterable

    from rce_master.advice import Advice
    from rce_master.state.placement import Room
    from rce_master.state.tables import Tables

_PIECE = 200
"""Containers of a machine between two turns of the event loop."""
_MOST_MOVABLE = 100
"""Containers of a machine that advice looks at."""
_NOTHING = EndpointUsage()
_NO_NODE_USAGE = NodeUsage()


class UsageViews:
    """Shows the usage of containers and machines at one moment.

    Args:
        tables: The state's tables.
        book: The reports of the task sets.
        reader: The user who reads it; commands about containers of others name their user.
    """

    def __init__(self, tables: Tables, book: UsageBook, reader: str = "") -> None:
        self._tables = tables
        self._book = book
        self._reader = reader
        self._rooms = {room.process: room for room in tables.rooms}

    def container(self, container: Container) -> models.ContainerUsageOut:
        """Show a container."""
        history = self._book.history(container.task_set, container.id)
        usage = history.now.usage if history else _NOTHING
        rates = history.rates if history else NO_RATES
        nodes = self._nodes(container, history)
        live, room = self._tables.container_live(container.id), self._rooms.get(container.task_set)
        return models.ContainerUsageOut(
            id=container.id,
            user=container.user,
            tag=container.tag,
            state=live.phase.value,
            machine=room.machine.name if room else "",
            cpu=round(rates.cpu, 3),
            cpu_limit=usage.cpu_limit,
            throttled=round(rates.throttled, 3),
            cpu_s=usage.cpu_s,
            throttled_s=usage.throttled_s,
            memory=usage.memory,
            memory_peak=max(usage.memory_peak, usage.memory),
            memory_limit=usage.memory_limit,
            oom_kills=usage.oom_kills,
            io_read=usage.io_read,
            io_written=usage.io_written,
            io_read_rate=round(rates.io_read),
            io_written_rate=round(rates.io_written),
            link_in=usage.link_in,
            link_out=usage.link_out,
            link_in_rate=round(rates.link_in),
            link_out_rate=round(rates.link_out),
            processes=usage.processes,
            restarts=sum(node.restarts for node in nodes),
            nodes=nodes,
            advice=_shown(self._advice(container, history, room)),
        )

    def _advice(self, container: Container, history: History | None, room: Room | None) -> list[Advice]:
        if history is None:
            return []
        user = "" if container.user == self._reader else container.user
        subject = advice.Subject(container.tag, container.resources, user)
        return advice.for_container(subject, history, room, self._open)

    @cached_property
    def _open(self) -> list[Room]:
        """The machines that take containers, the emptiest first."""
        there = self._tables.is_connected
        open_ = [room for room in self._rooms.values() if not room.draining and there(room.process)]
        return sorted(open_, key=lambda room: room.load)

    def _nodes(self, container: Container, history: History | None) -> list[models.NodeUsageOut]:
        status = self._tables.container_live(container.id).status
        reported = {node.tag: node for node in status.nodes} if status else {}
        return [_node(tag, reported.get(tag), history) for tag in container.nodes]

    async def machines(self) -> list[models.MachineUsageOut]:
        """Show all container machines; other tasks run meanwhile."""
        return [await self._machine(room) for room in self._rooms.values()]

    async def _machine(self, room: Room) -> models.MachineUsageOut:
        cpu, memory = 0.0, 0
        movable: list[advice.Movable] = []
        is_full = advice.is_too_full(room)
        for number, id_ in enumerate(list(self._tables.endpoints.keys("task_set", room.process)), 1):
            history = self._book.history(room.process, id_)
            if history is not None:
                cpu += history.rates.cpu
                memory += history.now.usage.memory
            if is_full and len(movable) < _MOST_MOVABLE and (one := self._movable(id_)) is not None:
                movable.append(one)
            if number % _PIECE == 0:
                await asyncio.sleep(0)
        await asyncio.sleep(0)
        return models.MachineUsageOut(
            process=room.process,
            machine=room.machine.name,
            connected=self._tables.is_connected(room.process),
            draining=room.draining,
            containers=room.containers,
            slots=room.machine.slots,
            promised_slots=room.slots,
            cores=room.machine.cores,
            promised_cores=round(room.cpu, 4),
            cpu=round(cpu, 3),
            memory=room.machine.memory,
            promised_memory=room.memory,
            memory_used=memory,
            advice=_shown(advice.for_machine(room, self._open, movable)),
        )

    def _movable(self, id_: str) -> advice.Movable | None:
        """Return a container that can move by itself; None if it cannot, or is not a container.

        Those in a network of a group move with others, and those with volumes need a disk, too.
        """
        tables, container = self._tables, self._tables.endpoints.get(id_)
        if not isinstance(container, Container) or container.resources.volumes:
            return None
        if container.resources.network is Network.GROUP or tables.moves.get(id_) is not None:
            return None
        if tables.container_live(id_).phase is not ContainerPhase.RUNNING:
            return None
        return advice.Movable(container.user, container.tag, container.resources)


def _node(tag: str, status: NodeStatus | None, history: History | None) -> models.NodeUsageOut:
    usage = history.now.usage.nodes.get(tag, _NO_NODE_USAGE) if history else _NO_NODE_USAGE
    return models.NodeUsageOut(
        tag=tag,
        state=status.state.value if status else "unknown",
        cpu=round(history.node_cpu(tag), 3) if history else 0.0,
        cpu_s=usage.cpu_s,
        memory=usage.memory,
        processes=usage.processes,
        restarts=status.restarts if status else 0,
    )


def _shown(found: Iterable[Advice]) -> list[models.AdviceOut]:
    return [models.AdviceOut(about=one.about, text=one.text, command=one.command) for one in found]
