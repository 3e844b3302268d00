"""Environments that are in the hands of their nodes, and what their manager makes of what they say."""

from __future__ import annotations

import asyncio
import contextlib
import os
import socket
from collections.abc import AsyncIterator, Iterator
from pathlib import Path

import pytest
from support.container_specs import MACHINE
from support.containers import Machine, until

from rce.control.model import EndpointState, EndpointStatus, LinkAddress, NodeState, NodeStatus
from rce_container import intake
from rce_container.environment import messages as m
from rce_container.environment import proc
from rce_container.environment.channel import Channel

BOX, VICTIM = "user/box", "other/box"


@pytest.fixture
def machine(folder: Path) -> Iterator[Machine]:
    machine = Machine(folder, "process")
    yield machine
    machine.tidy()


def report(id_: str, *nodes: NodeStatus, revision: int = 1) -> bytes:
    status = EndpointStatus(id=id_, revision=revision, state=EndpointState.RUNNING, nodes=nodes)
    return m.encode(m.Report(status=status)) + b"\n"


class Rogue:
    """Plays the environment of a container whose manager is dead, for the manager that comes next."""

    def __init__(self, machine: Machine, incarnation_id: str) -> None:
        (path,) = (machine.folder / "run").glob(f"*/{incarnation_id}/control.sock")
        path.rename(path.with_name("former.sock"))
        self._mark = incarnation_id
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._listener.setblocking(False)
        self._listener.bind(str(path))
        self._listener.listen()
        self.manager: socket.socket

    async def greet(self, first: bytes) -> None:
        loop = asyncio.get_running_loop()
        self.manager, _ = await loop.sock_accept(self._listener)
        await self.say(first)

    async def say(self, *lines: bytes) -> None:
        await asyncio.get_running_loop().sock_sendall(self.manager, b"".join(lines))

    def close(self) -> None:
        """End, with the real environment, which nobody would tell to."""
        self.manager.close()
        self._listener.close()
        proc.strike(self._mark)


async def mark_of(machine: Machine, id_: str) -> str:
    def running() -> str:
        found = machine.status(id_)
        return found.incarnation if found is not None and found.state is EndpointState.RUNNING else ""

    return str(await until(running, what=f"{id_} runs"))


@contextlib.asynccontextmanager
async def taken_over(machine: Machine, first: bytes) -> AsyncIterator[tuple[Rogue, str]]:
    """A new manager that adopted a rogue (BOX), which said ``first``, and a sound container (VICTIM)."""
    async with machine.managed():
        await machine.put(BOX)
        await machine.put(VICTIM)
        incarnation_id, victim = [await mark_of(machine, id_) for id_ in (BOX, VICTIM)]
    rogue = Rogue(machine, incarnation_id)
    greeting = asyncio.create_task(rogue.greet(first))
    async with machine.engine():
        await greeting
        yield rogue, victim
        rogue.close()
        for id_ in (BOX, VICTIM):
            await machine.drop(id_)


async def test_who_claims_to_be_another_container_is_adopted_as_itself(machine: Machine) -> None:
    claim = report(VICTIM, NodeStatus(tag="evil", state=NodeState.RUNNING))
    async with taken_over(machine, claim) as (_, victim):
        statuses = {status.id: status for status in machine.manager.statuses}
        assert set(statuses) == {BOX, VICTIM}
        assert statuses[VICTIM].incarnation == victim, "it is the one that it was"
        assert statuses[VICTIM].nodes == ()
        assert [node.tag for node in statuses[BOX].nodes] == ["evil"]


async def test_a_revision_that_the_master_did_not_give_is_not_believed(machine: Machine) -> None:
    """A manager that adopts a container has no spec of it yet, and asks its environment for none."""
    async with taken_over(machine, report(BOX, revision=2**52)) as (rogue, _):
        given = 1
        (status,) = [one for one in machine.manager.statuses if one.id == BOX]
        assert status.revision <= given
        await rogue.say(report(BOX, NodeStatus(tag="seen", state=NodeState.RUNNING), revision=2**52))
        await until(lambda: machine.reported(BOX).nodes, what="the second report")
        assert machine.reported(BOX).revision <= given


async def test_who_never_stops_talking_keeps_nobody_waiting(machine: Machine) -> None:
    async with taken_over(machine, report(BOX)) as (rogue, _):

        async def talk() -> None:
            flood = [m.encode(m.Killed(request=1)) + b"\n"] * 2000
            with contextlib.suppress(OSError):
                while True:
                    await rogue.say(*flood)

        talking = asyncio.create_task(talk())
        await machine.put("third/box")
        await mark_of(machine, "third/box")
        assert not talking.done()
        talking.cancel()
        await machine.drop("third/box")


def channel_of(machine: Machine, id_: str) -> Channel:
    (channel,) = [one._channel for one in machine.manager._incarnations.values() if one.id == id_]
    assert channel is not None
    return channel


async def test_answers_that_are_not_read_are_limited(machine: Machine) -> None:
    async with taken_over(machine, report(BOX)) as (rogue, _):
        channel = channel_of(machine, BOX)
        asking = asyncio.create_task(rogue.say(*[m.encode(m.Killed(request=1)) + b"\n"] * 20_000))
        await until(lambda: len(channel._unsent) > intake.MAX_UNREAD, what="answers wait")
        await machine.put("third/box")
        await mark_of(machine, "third/box")
        assert len(channel._unsent) < 1000
        assert not asking.done(), "its questions were read all the same"

        async def read() -> None:
            while not asking.done():
                await asyncio.get_running_loop().sock_recv(rogue.manager, 1 << 16)

        async with asyncio.timeout(60):
            await read()
        await machine.drop("third/box")


async def test_dialed_sockets_that_are_not_taken_are_limited(machine: Machine) -> None:
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    listener.bind(str(machine.folder / "peer"))
    listener.listen(4096)
    address = LinkAddress(machine=MACHINE, unix=str(machine.folder / "peer"))
    with listener:
        async with taken_over(machine, report(BOX)) as (rogue, _):
            await machine.put(BOX, 2, peer="other/box", dial=address)
            channel = channel_of(machine, BOX)
            before = len(list(Path("/proc/self/fd").iterdir()))
            asking = asyncio.create_task(
                rogue.say(*[m.encode(m.Dial(request=1, address=address)) + b"\n"] * 5000)
            )
            await until(lambda: len(channel._unsent) > intake.MAX_UNREAD, what="answers wait")
            await machine.put("third/box")
            await mark_of(machine, "third/box")
            assert len(list(Path("/proc/self/fd").iterdir())) - before < 400
            assert not asking.done(), "its questions were read all the same"
            asking.cancel()
            await machine.drop("third/box")


async def test_descriptors_that_nobody_wants_are_not_kept(machine: Machine) -> None:
    async with taken_over(machine, report(BOX)) as (rogue, _):
        await until(lambda: machine.status(BOX) is not None, what="the rogue is adopted")
        reading, writing = os.pipe()
        node = NodeStatus(tag="later", state=NodeState.RUNNING)
        socket.send_fds(rogue.manager, [report(BOX, node)], [writing] * 10)
        os.close(writing)
        await until(lambda: machine.node(BOX, "later"), what="the report was read")
        assert os.read(reading, 1) == b"", "all copies of the pipe's other end are closed"
        os.close(reading)


@pytest.mark.parametrize("line", [b"nonsense", b'{"t":"Report","x":' + b"[" * 100_000])
async def test_who_talks_nonsense_is_ended_alone(machine: Machine, line: bytes) -> None:
    async with taken_over(machine, report(BOX)) as (rogue, victim):
        before = machine.status(BOX)
        assert before is not None
        await machine.put(BOX)
        await rogue.say(line, b"\n")
        await until(
            lambda: (now := machine.status(BOX)) and now.incarnation not in ("", before.incarnation),
            what="it is made again",
        )
        assert await mark_of(machine, VICTIM) == victim
        assert any("cannot be talked to" in text for text in machine.faults)
