"""Resources over the API and the commands: admission, resizing, draining, usage, health."""

from __future__ import annotations

import asyncio
import errno
import io
import json
import os
from collections.abc import Awaitable
from typing import TYPE_CHECKING, Any

import pytest
import typer
from rich.console import Console
from support.engine import until

from rce.control.messages import Drop, Gone, MachineInfo, Put, TaskSetKind, Usage
from rce.control.model import EndpointState, EndpointStatus, EndpointUsage, NodeState, NodeStatus, NodeUsage
from rce.model.specs import RestartPolicy
from rce_master.audit import AuditLog
from rce_master.auth import client_digest
from rce_master.cli import machines, top
from rce_master.cli.client import ApiClient
from rce_master.cli.credentials import FILE_VARIABLE, Credentials, save
from rce_master.cli.exceptions import ApiError
from rce_master.exceptions import StoreError
from rce_master.store import MemoryStore, Row

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from integration.master.conftest import RunSite, Site, TaskSet


MB = 1 << 20


def small(name: str = "m1") -> MachineInfo:
    return MachineInfo(name=name, cores=2, memory=1024 * MB, slots=8)


@pytest.fixture
def logged_in(site: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Site:
    monkeypatch.setenv(FILE_VARIABLE, str(tmp_path / "login.json"))
    save(Credentials(url=site.url, user="testUser", token=site.token, expires=2e9))
    return site


async def put_of(task_set: TaskSet, id_: str, **wanted: float) -> Put:
    while True:
        put = await task_set.get(Put)
        resources = put.endpoint.resources
        if put.endpoint.id == id_ and all(getattr(resources, key) == value for key, value in wanted.items()):
            return put


def running(id_: str, *nodes: NodeStatus) -> EndpointStatus:
    return EndpointStatus(id=id_, revision=1, state=EndpointState.RUNNING, incarnation="1", nodes=nodes)


async def container(site: Site, tag: str) -> dict[str, Any]:
    found = (await site.api("GET", "/containers"))["containers"]
    return next(c for c in found if c["tag"] == tag)


async def test_amounts_are_read_and_out_of_capacity_is_a_conflict(site: Site) -> None:
    async with site.containers(machine=small()) as there:
        body = {"tag": "c", "cpu": "50%", "memory": "256M", "bandwidth": "8Mbit", "size": 2}
        await site.api("POST", "/containers", body, status=204)
        put = await put_of(there, "testUser/c")
        requested = put.endpoint.resources
        assert (requested.cpu, requested.memory, requested.bandwidth, requested.size) == (
            0.5,
            256 * MB,
            1_000_000,
            2,
        )
        shown = (await container(site, "c"))["wish"]
        assert (shown["cpu"], shown["memory"], shown["network"]) == (0.5, 256 * MB, "none")
        reply = await site.api("POST", "/containers", {"tag": "d", "cpu": 4}, status=409)
        assert "m1 has 1.5 of 2 cores free, 4 needed" in reply["error"]
        reply = await site.api("POST", "/containers", {"tag": "d", "memory": "lots"}, status=422)
        assert reply["error"].startswith("memory: must be a number of MB such as 256")
        await site.api("POST", "/containers", {"tag": "d", "cpu": 4, "wait": True}, status=204)
        shown = await container(site, "d")
        assert shown["state"] == "requested"
        assert shown["detail"] == "m1 has 1.5 of 2 cores free, 4 needed"
        (machine,) = (await site.api("GET", "/machines"))["machines"]
        assert (machine["promised_cores"], machine["promised_slots"], machine["slots"]) == (0.5, 2, 8)


@pytest.mark.parametrize(
    ("path", "body", "place"),
    [
        ("/containers", {"tag": "a b"}, "tag: must be a name"),
        ("/containers", {"tag": "c", "network": "group"}, "group: is missing"),
        ("/containers", {"tag": "c", "group": "g", "group_ip": "300.1.1.1"}, "group_ip: must be an IPv4"),
        ("/containers/c/nodes", {"tag": "", "pkg": "p", "exe": "x"}, "tag: "),
        ("/containers/1/nodes", {"tag": "n", "pkg": "p", "exe": "x"}, "container: "),
        ("/containers/c/nodes", {"tag": "n", "pkg": "p", "exe": "x", "max_restarts": -1}, "max_restarts: "),
        ("/endpoints/c/interfaces", {"tag": "i", "type": "x", "cls": "p/T"}, "type: "),
        ("/endpoints/c/interfaces", {"tag": "i", "type": "PublisherInterface", "cls": "T"}, "cls: "),
        ("/connections", {"tag_a": "x", "tag_b": "a/b"}, "tag_a: "),
    ],
)
async def test_faults_name_the_keys_of_this_api(site: Site, path: str, body: object, place: str) -> None:
    reply = await site.api("POST", path, body, status=422)
    assert reply["error"].startswith(place)


async def test_how_a_node_lives_reaches_its_machine(site: Site) -> None:
    async with site.containers() as there:
        await site.api("POST", "/containers", {"tag": "c"}, status=204)
        node = {"tag": "n", "pkg": "p", "exe": "e", "restart": "always", "max_restarts": 3, "after": ["m"],
                "heartbeat": "/beat", "heartbeat_timeout": 2.0}  # fmt: skip
        await site.api("POST", "/containers/c/nodes", node, status=204)
        put = await there.get(Put)
        while not put.endpoint.nodes:
            put = await there.get(Put)
        (spec,) = put.endpoint.nodes
        assert (spec.restart, spec.max_restarts, spec.after) == (RestartPolicy.ALWAYS, 3, ("m",))
        assert (spec.heartbeat, spec.heartbeat_timeout) == ("/beat", 2.0)
        there.report(running("testUser/c", NodeStatus(tag="n", state=NodeState.STUCK, restarts=2)))

        async def shown() -> dict[str, Any]:
            return dict((await site.api("GET", "/nodes"))["nodes"][0])

        await until(lambda: _is(shown, "state", "stuck"))
        found = await shown()
        assert (found["restarts"], found["restart"], found["after"]) == (2, "always", ["m"])
        bad = {**node, "tag": "o", "restart": "often"}
        reply = await site.api("POST", "/containers/c/nodes", bad, status=422)
        assert "restart: must be one of never, on-failure, always" in reply["error"]


async def _is(read: Callable[[], Awaitable[dict[str, Any]]], key: str, value: object) -> bool:
    return bool((await read())[key] == value)


async def test_a_container_is_resized_over_rest_and_by_command(
    logged_in: Site, capsys: pytest.CaptureFixture[str]
) -> None:
    site = logged_in
    async with site.containers(machine=small()) as there:
        await site.api("POST", "/containers", {"tag": "c", "cpu": 1}, status=204)
        await site.api("PATCH", "/containers/c", {"cpu": "50%", "memory": 256}, status=204)
        await put_of(there, "testUser/c", cpu=0.5, memory=256 * MB)
        reply = await site.api("PATCH", "/containers/c", {"cpu": 3}, status=409)
        assert "cannot grow so far: m1 has 2 of 2 cores free, 3 needed; nothing was changed" in reply["error"]
        assert "says nothing" in (await site.api("PATCH", "/containers/c", {}, status=422))["error"]
        await site.api("PATCH", "/containers/x", {"cpu": 1}, status=404)
        await machines._resize("c", {"memory": "512M", "size": 3}, "")
        await put_of(there, "testUser/c", cpu=0.5, memory=512 * MB, size=3)
        with pytest.raises(ApiError, match="m1 has 8 of 8 slots free, 9 needed"):
            await machines._resize("c", {"size": 9}, "")
    assert capsys.readouterr().out == "resized c: memory 512M, size 3\n"
    with pytest.raises(typer.BadParameter, match="give one or more of"):
        machines.resize("c")


async def test_a_client_resizes_over_its_socket(site: Site) -> None:
    async with site.robots() as robots, site.containers(machine=small()) as there:
        await robots.channel.login("testUser", "rob", client_digest("testUser"))

        async def ask(kind: str, data: dict[str, Any]) -> Sequence[str]:
            return (await robots.channel.client_request("testUser/rob", kind, data)).errors

        assert not await ask("CC", {"containerTag": "c", "containerData": {"cpu": 1}})
        assert not await ask("RC", {"containerTag": "c", "containerData": {"cpu": "25%"}})
        await put_of(there, "testUser/c", cpu=0.25)
        assert not await ask("CC", {"containerTag": "c", "containerData": {"cpu": 1}}), "as after a reconnect"
        (error,) = await ask("RC", {"containerTag": "c", "containerData": {"cpu": 9}})
        assert error.startswith("RC: container 'c' cannot grow so far: m1 has 2 of 2 cores free")
        (error,) = await ask("RC", {"containerTag": "c", "containerData": {"cpu": "x"}})
        assert error.startswith("RC: data.containerData.cpu: must be a number of cores")


async def test_a_machine_is_drained_by_command(logged_in: Site, capsys: pytest.CaptureFixture[str]) -> None:
    site = logged_in
    async with site.containers(machine=small()) as first:
        await site.api("POST", "/containers", {"tag": "c"}, status=204)
        await put_of(first, "testUser/c")
        first.report(running("testUser/c"))
        await until(lambda: _is(lambda: container(site, "c"), "state", "running"))
        await machines._drain("m1", wait=False)
        assert "testUser/c: there is no other machine" in capsys.readouterr().out
        async with site.containers("c2", machine=small("m2")) as second:
            draining = asyncio.create_task(machines._drain("m1", wait=True))
            await put_of(second, "testUser/c")
            assert (await container(site, "c"))["moving_to"] == "c2"
            second.report(running("testUser/c"))
            assert (await first.get(Drop)).id == "testUser/c"
            first.channel.send(Gone(id="testUser/c", revision=99))
            await draining
            shown = await container(site, "c")
            assert (shown["machine"], shown["state"], shown["moving_to"]) == ("m2", "running", "")
            await machines._machines(as_json=False)
            await machines._undrain("m1")
            await site.api("PUT", "/machines/m3/drain", status=404)
    text = capsys.readouterr().out
    assert "testUser/c: is being handed over to c2\ntestUser/c: is elsewhere now\nit is empty\n" in text
    assert "draining" in text
    assert text.endswith("m1 takes containers and robots again\n")


async def test_a_container_is_moved_by_command(logged_in: Site, capsys: pytest.CaptureFixture[str]) -> None:
    site = logged_in
    async with site.containers(machine=small()) as first:
        await site.api("POST", "/containers", {"tag": "c"}, status=204)
        await put_of(first, "testUser/c")
        first.report(running("testUser/c"))
        await until(lambda: _is(lambda: container(site, "c"), "state", "running"))
        async with site.containers("c2", machine=small("m2")) as second:
            moving = asyncio.create_task(machines._move("c", "m2", "", wait=True))
            await put_of(second, "testUser/c")
            reply = await site.api("PUT", "/containers/c/machine", {"machine": "m2"}, status=409)
            assert "moves to c2 already" in reply["error"]
            second.report(running("testUser/c"))
            assert (await first.get(Drop)).id == "testUser/c"
            await moving
            assert (await container(site, "c"))["machine"] == "m2"
            reply = await site.api("PUT", "/containers/c/machine", {"machine": "m1"}, status=409)
            assert "a container of its name is still ending there" in reply["error"]
            await site.api("PUT", "/containers/c/machine", {"machine": "m9"}, status=404)
            await site.api("PUT", "/containers/c/machine", {}, status=422)
    assert capsys.readouterr().out == "c moves to m2\nc is there\n"


async def test_only_administrators_drain(site: Site) -> None:
    await site.api("POST", "/users", {"name": "anna", "password": "one"}, status=201)
    anna = await site.login("anna", "one")
    await site.api("PUT", "/machines/m1/drain", token=anna, status=403)
    await site.api("PUT", "/containers/c/machine", {"machine": "m1"}, token=anna, status=403)
    assert (await site.api("GET", "/usage", token=anna))["machines"] == []


async def test_a_drain_outlives_a_restart(run_site: RunSite) -> None:
    store = MemoryStore()
    async with run_site(store) as site, site.containers(machine=small()):
        await site.api("PUT", "/machines/m1/drain")
    async with run_site(store) as site, site.containers(machine=small()):
        reply = await site.api("POST", "/containers", {"tag": "c"}, status=409)
        assert "m1 is draining" in reply["error"]
        await site.api("DELETE", "/machines/c1/drain")
        await site.api("POST", "/containers", {"tag": "c"}, status=204)


# Usage


def told(cpu: float, *, oom_kills: int = 0) -> EndpointUsage:
    return EndpointUsage(
        cpu_s=cpu,
        throttled_s=cpu / 2,
        memory=250 * MB,
        memory_peak=255 * MB,
        memory_limit=256 * MB,
        cpu_limit=0.5,
        oom_kills=oom_kills,
        io_read=4096,
        link_out=1 << 20,
        processes=3,
        nodes={"n": NodeUsage(cpu_s=cpu, memory=200 * MB, processes=2), "unknown": NodeUsage(cpu_s=9)},
    )


async def using(site: Site, there: TaskSet) -> dict[str, Any]:
    """A container that uses something; waits until the master knows, and returns what it tells."""
    await site.api("POST", "/containers", {"tag": "c", "memory": "256M"}, status=204)
    await site.api("POST", "/containers/c/nodes", {"tag": "n", "pkg": "p", "exe": "e"}, status=204)
    there.report(running("testUser/c", NodeStatus(tag="n", state=NodeState.RUNNING, restarts=2)))
    there.channel.send(Usage(cpu_s=1.0, memory=1, endpoints={"testUser/c": told(1.0)}))

    async def first() -> dict[str, Any] | None:
        usage: dict[str, Any] = await site.api("GET", "/usage")
        return usage if usage["containers"][0]["memory"] else None

    await until(first)
    await asyncio.sleep(0.2)  # a rate needs two looks, some time apart
    there.channel.send(Usage(cpu_s=1.0, memory=1, endpoints={"testUser/c": told(1.1, oom_kills=1)}))

    async def second() -> dict[str, Any] | None:
        usage: dict[str, Any] = await site.api("GET", "/usage")
        return usage if usage["containers"][0]["oom_kills"] else None

    return await until(second)


async def test_usage_is_told_with_rates_and_advice(site: Site) -> None:
    async with site.containers(machine=small()) as there:
        usage = await using(site, there)
        (found,) = usage["containers"]
        assert (found["id"], found["state"], found["machine"]) == ("testUser/c", "running", "m1")
        assert 0 < found["cpu"] <= 0.5
        assert (found["memory"], found["memory_limit"], found["restarts"]) == (250 * MB, 256 * MB, 2)
        assert [(node["tag"], node["restarts"], node["processes"]) for node in found["nodes"]] == [
            ("n", 2, 2)
        ]
        (advice,) = found["advice"]
        assert advice["command"] == "rce resize c --memory 512M"
        (machine,) = usage["machines"]
        assert (machine["promised_memory"], machine["memory_used"]) == (256 * MB, 250 * MB)


async def test_usage_is_streamed(site: Site) -> None:
    async with site.containers(machine=small()) as there:
        await using(site, there)
        headers = {"Authorization": f"Bearer {site.token}"}
        async with site.session.get(
            f"{site.url}api/v1/usage/live", params={"interval": 1}, headers=headers
        ) as reply:
            lines = [await reply.content.readline() for _ in range(5)]
        assert [line for line in lines if line.startswith(b"event")] == [b"event: usage\n"] * 2
        assert json.loads(lines[1][6:])["containers"][0]["tag"] == "c"
    await site.api("GET", "/usage/live", status=422, interval=0)


async def test_usage_is_measured_and_ends_with_its_container(site: Site) -> None:
    async def metrics() -> str:
        async with site.session.get(f"{site.url}metrics") as reply:
            return await reply.text()

    async with site.containers(machine=small()) as there:
        await using(site, there)
        text = await metrics()
        for line in (
            'rce_container_cpu_seconds_total{container="testUser/c"} 1.1',
            'rce_container_oom_kills_total{container="testUser/c"} 1.0',
            f'rce_container_memory_limit_bytes{{container="testUser/c"}} {256.0 * MB}',
            'rce_container_cpu_limit_cores{container="testUser/c"} 0.5',
            'rce_container_io_bytes_total{container="testUser/c",direction="read"} 4096.0',
            f'rce_container_link_bytes_total{{container="testUser/c",direction="out"}} {1.0 * MB}',
            'rce_node_cpu_seconds_total{container="testUser/c",node="n"} 1.1',
            'rce_node_restarts_total{container="testUser/c",node="n"} 2.0',
            'rce_machine_slots{machine="m1",process="c1"} 8.0',
            'rce_machine_promised_memory_bytes{machine="m1",process="c1"} 2.68435456e+08',
            "rce_metrics_omitted 0.0",
        ):
            assert (
                line in text
                or line.replace("268435456.0", "2.68435456e+08") in text
                or line.replace("1048576.0", "1.048576e+06") in text
            ), line
        assert "unknown" not in text, "an undesired name is not a label"
        await site.api("DELETE", "/containers/c", status=204)
        text = await metrics()
        assert "testUser/c" not in text


async def test_top_shows_it_once_when_piped(logged_in: Site, capsys: pytest.CaptureFixture[str]) -> None:
    async with logged_in.containers(machine=small()) as there:
        await using(logged_in, there)
        await top._top(1.0, top.Look(top.Order.MEMORY, nodes=True, interfaces=True), once=True)
    text = capsys.readouterr().out
    for part in ("testUser/c", "running", "250 MiB", "98%", "m1 (c1)", "  n ", "rce resize c --memory 512M"):
        assert part in text, text
    assert "too small: its memory ran out once lately" in text


async def test_top_sorts(site: Site) -> None:
    async with site.containers(machine=small()) as there:
        usage = await using(site, there)
    quiet = {**usage["containers"][0], "id": "anna/quiet", "user": "anna", "cpu": 0.0, "memory": 1 << 40}
    usage["containers"] = [quiet, usage["containers"][0]]
    usage["masters"] = [{"name": "m7:9000", "role": "standby", "url": "http://m7:9000/", "drained": True}]

    def shown(order: top.Order) -> str:
        console = Console(file=io.StringIO(), width=200)
        console.print(top.layout(usage, top.Look(order)))
        assert isinstance(console.file, io.StringIO)
        return console.file.getvalue()

    by_cpu, by_memory = shown(top.Order.CPU), shown(top.Order.MEMORY)
    assert by_cpu.index("testUser/c") < by_cpu.index("anna/quiet")
    assert by_memory.index("anna/quiet") < by_memory.index("testUser/c")
    assert "rce resize c --memory 512M" in by_cpu
    assert " ".join(by_cpu.split()).count("m7:9000 standby drained") == 1


# Health


class BrokenStore(MemoryStore):
    """Breaks when it is told to."""

    broken = False

    async def save(self, rows: Sequence[Row], term: int = 0) -> None:
        if self.broken:
            raise StoreError("cannot write the store: no space is left")
        await super().save(rows, term)


async def test_health_tells_of_a_broken_store(
    run_site: RunSite,
) -> None:
    store = BrokenStore()

    async def health(site: Site) -> tuple[int, str]:
        async with site.session.get(f"{site.url}healthz") as reply:
            return reply.status, (await reply.json())["status"]

    async with run_site(store) as site:
        assert await health(site) == (200, "ok")
        store.broken = True
        await site.api("POST", "/containers", {"tag": "c"}, status=503)
        assert await health(site) == (503, "cannot write the store: no space is left")
        store.broken = False
        await site.api("POST", "/containers", {"tag": "c"}, status=204)
        assert await health(site) == (200, "ok")


async def test_health_is_good_again_without_a_write(run_site: RunSite) -> None:
    """A load balancer that asks for the health sends no writes to a master that answers 503."""
    store = BrokenStore()

    async def status(site: Site) -> int:
        async with site.session.get(f"{site.url}healthz") as reply:
            return reply.status

    async with run_site(store) as site:
        store.broken = True
        await site.api("POST", "/containers", {"tag": "c"}, status=503)
        assert await status(site) == 503
        store.broken = False
        async with asyncio.timeout(60):
            while await status(site) != 200:
                await asyncio.sleep(0.05)


async def test_health_tells_of_a_full_disk(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(AuditLog, "_append", full)
    await site.api("POST", "/containers", {"tag": "c"}, status=204)
    async with site.session.get(f"{site.url}healthz") as reply:
        said = (await reply.json())["status"]
    assert (reply.status, said) == (200, "ok; the audit log cannot be written: No space left on device")


async def test_a_task_set_without_a_name_is_told_so(site: Site, caplog: pytest.LogCaptureFixture) -> None:
    async with site.containers() as there:
        nameless = type(there)(site.master, TaskSetKind.CONTAINER, "")
        dialing = asyncio.create_task(nameless.channel.run())
        await until(lambda: "'' names no task set" in caplog.text)
        dialing.cancel()
        await asyncio.gather(dialing, return_exceptions=True)
        assert [m["process"] for m in (await site.api("GET", "/machines"))["machines"]] == ["c1"]


async def test_the_commands_client_patches(site: Site) -> None:
    async with ApiClient(site.url, site.token) as client:
        await client.call("POST", "/containers", {"tag": "c"})
        await client.call("PATCH", "/containers/c", {"cpu": 1})
    assert (await container(site, "c"))["wish"]["cpu"] == 1.0
