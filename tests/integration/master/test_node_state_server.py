"""Snapshots of nodes' states at a real master: kept, fetched, refused; and what is not one."""

from __future__ import annotations

import asyncio
import hashlib
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import msgspec
import pytest
from integration.master.conftest import SECRET, Site, TaskSet, running_site
from support.engine import until
from websockets.exceptions import ConnectionClosed

from rce.control import NODE_STATES, NodeStateError
from rce.control.messages import MachineInfo, SaveState, StateSaved, TaskSetKind
from rce.control.model import EndpointState, EndpointStatus
from rce.control.node_states import PATH, PIECE, Fetch, Keep, Ready, Refusal, encode, read_answer
from rce.control_channel.dialing import Dialer
from rce.control_channel.node_states import NodeStateClient
from rce.masters import Masters
from rce.model import MAX_STATE

C = "testUser/C"
SERVICES = {"save": "save", "restore": "restore"}


def dialer(site: Site) -> Dialer:
    return Dialer(Masters(f"ws://127.0.0.1:{site.master.control_port}"), SECRET)


def client(site: Site) -> NodeStateClient:
    return NodeStateClient(dialer(site))


def keep(state: bytes, number: int = 1, **changes: Any) -> Keep:
    question = Keep(
        process="c1",
        id=C,
        node="n",
        incarnation="one",
        number=number,
        size=len(state),
        sha256=hashlib.sha256(state).hexdigest(),
    )
    return msgspec.structs.replace(question, **changes)


async def fetched(site: Site, process: str = "c1", node: str = "n") -> bytes | None:
    return await client(site).fetch(Fetch(process=process, id=C, node=node), MAX_STATE)


async def listed(site: Site) -> list[dict[str, Any]]:
    return list((await site.api("GET", "/states"))["states"])


async def faults(site: Site) -> list[str]:
    headers = {"Authorization": f"Bearer {site.token}", "Accept": "application/json"}
    async with site.session.get(f"{site.url}api/v1/events", headers=headers) as reply:
        return [one["text"] for one in (await reply.json())["events"] if one["kind"] == "fault"]


async def report(site: Site, task_set: TaskSet, incarnation: str) -> None:
    """Report the container, and wait until the master knows it."""
    task_set.report(EndpointStatus(id=C, revision=1, state=EndpointState.RUNNING, incarnation=incarnation))

    async def known() -> bool:
        (container,) = (await site.api("GET", "/containers"))["containers"]
        return bool(container["incarnation"] == incarnation)

    await until(known, what=f"{incarnation} is known")


@asynccontextmanager
async def placed(site: Site) -> AsyncIterator[TaskSet]:
    """A task set with a container that has a node whose state is kept."""
    machine = MachineInfo(name="m1", cores=2, slots=8)
    features = (NODE_STATES,)
    async with site.task_set(TaskSetKind.CONTAINER, "c1", machine=machine, features=features) as there:
        await site.api("POST", "/containers", {"tag": "C"}, status=204)
        node = {"tag": "n", "pkg": "Test", "exe": "counter.py", "state_services": SERVICES}
        await site.api("POST", "/containers/C/nodes", node, status=204)
        await report(site, there, "one")
        yield there


@pytest.mark.parametrize("size", [0, 1, PIECE, PIECE + 1, MAX_STATE])
async def test_what_is_kept_is_fetched(site: Site, size: int) -> None:
    state = (bytes(range(251)) * (size // 251 + 1))[:size]
    async with placed(site):
        assert await fetched(site) is None
        await client(site).keep(keep(state), state)
        assert await fetched(site) == state
        (found,) = await listed(site)
        assert (found["container"], found["node"], found["size"]) == ("C", "n", size)
        assert (found["machine"], found["number"]) == ("m1", 1)


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"process": "c2"}, "somewhere else"),
        ({"incarnation": "two"}, "somewhere else"),
        ({"node": "x"}, "no node 'x' whose state is kept"),
        ({"id": "testUser/D"}, "there is no container"),
        ({"number": 1}, "a newer snapshot is there"),
        ({"size": MAX_STATE + 1}, "larger than 16 MB"),
        ({"sha256": "0" * 64}, "changed on its way"),
    ],
)
async def test_what_may_not_be_kept_changes_nothing(site: Site, changes: dict[str, Any], text: str) -> None:
    async with placed(site):
        await client(site).keep(keep(b"first", 1), b"first")
        with pytest.raises(NodeStateError, match=text):
            await client(site).keep(keep(b"second", **{"number": 2, **changes}), b"second")
        assert await fetched(site) == b"first"


async def test_the_rest_api_and_the_disk_limit(site: Site) -> None:
    async with placed(site):
        await client(site).keep(keep(b"x" * 1000), b"x" * 1000)
        limits = (await site.api("GET", "/users/testUser"))["limits"]
        assert limits["disk"]["used"] == 1000
        await site.api("PATCH", "/users/testUser/limits", {"disk": "2000B"})
        with pytest.raises(NodeStateError, match="rce user limit testUser --disk"):
            await client(site).keep(keep(b"x" * 3000, 2), b"x" * 3000)
        await site.api("DELETE", "/states/C/n", status=204)
        assert await fetched(site) is None
        reply = await site.api("DELETE", "/states/C/n", status=404)
        assert "rce state list" in reply["error"]


async def test_contents_of_older_snapshots_are_removed(tmp_path: Path) -> None:
    async with running_site(state_dir=tmp_path) as site, placed(site):
        for number in range(1, 4):
            state = b"%d" % number
            await client(site).keep(keep(state, number), state)
        wanted = [hashlib.sha256(b"3").hexdigest()]

        def held() -> bool:
            return [path.name for path in (tmp_path / "bundles").iterdir() if len(path.name) == 64] == wanted

        await until(held, what="only the newest is there")
        assert await fetched(site) == b"3"
        await site.api("DELETE", "/containers/C", status=204)
        await until(lambda: not list((tmp_path / "bundles").glob("?" * 64)), what="none is there")


async def test_a_missing_content_is_not_taken_for_an_empty_one(tmp_path: Path) -> None:
    async with running_site(state_dir=tmp_path) as site, placed(site):
        await client(site).keep(keep(b"first"), b"first")
        (tmp_path / "bundles" / keep(b"first").sha256).unlink()
        with pytest.raises(NodeStateError, match="rce state remove gives it up"):
            await fetched(site)
        await client(site).keep(keep(b"second", 2), b"second")
        assert await fetched(site) == b"second"


async def test_a_container_that_moves_saves_once_more(site: Site) -> None:
    """Its former task set saves when the copy asks; if it fails, the copy gets the snapshot before."""
    async with placed(site) as there:
        await client(site).keep(keep(b"first"), b"first")
        machine = MachineInfo(name="m2", cores=2, slots=8)
        async with site.task_set(TaskSetKind.CONTAINER, "c2", machine=machine):
            await site.api("PUT", "/containers/C/machine", {"machine": "m2"}, status=202)
            asking = asyncio.create_task(fetched(site, "c2"))
            order = await there.get(SaveState)
            assert (order.id, order.node) == (C, "n")
            await client(site).keep(keep(b"second", 2), b"second")
            there.channel.send(StateSaved(request=order.request))
            assert await asking == b"second"
            asking = asyncio.create_task(fetched(site, "c2"))
            order = await there.get(SaveState)
            there.channel.send(StateSaved(request=order.request, error="it hangs"))
            assert await asking == b"second"
            (told,) = await faults(site)
            assert told == "container C: node n moves with the state that was saved before: it hangs"
        with pytest.raises(NodeStateError, match="at another machine"):
            await fetched(site, "c2")


@pytest.mark.parametrize(
    "first", ["", "{}", '{"t":"Keep"}', '{"t":"Else","process":"c1","id":"u/c","node":"n"}', b"\xff", "[" * 9]
)
async def test_garbage_ends_the_connection_only(site: Site, first: str | bytes) -> None:
    async with placed(site):
        async with dialer(site).connect(PATH, PIECE) as master:
            await master.send(first)
            with pytest.raises(ConnectionClosed):
                async with asyncio.timeout(30):
                    await master.recv()
        await client(site).keep(keep(b"first"), b"first")


@pytest.mark.parametrize("pieces", [[b"123456"], ["12345"], [b""], [b"123"]])
async def test_pieces_that_do_not_fit_are_not_kept(site: Site, pieces: list[bytes | str]) -> None:
    async with placed(site):
        async with dialer(site).connect(PATH, PIECE) as master:
            await master.send(encode(keep(b"12345")).decode())
            assert read_answer(await master.recv()) == Ready()
            for piece in pieces:
                await master.send(piece)
        assert await listed(site) == []


async def test_a_wrong_answer_is_not_a_snapshot(site: Site) -> None:
    """The client is told what the master says of it."""
    async with placed(site):
        async with dialer(site).connect(PATH, PIECE) as master:
            await master.send(encode(Fetch(process="c9", id=C, node="n")).decode())
            answer = read_answer(await master.recv())
        assert isinstance(answer, Refusal)
        assert "another machine" in answer.reason
