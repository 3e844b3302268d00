"""Container machines with labels and slots: placement, resizing, handing over; the end of sessions."""

from __future__ import annotations

import asyncio
import contextlib
import json
import urllib.error
import urllib.request
from collections.abc import AsyncIterator
from typing import Any

import pytest
from support.engine import Engine, Program, running_engine, until

from rce_client.connection import Connection
from rce_client.exceptions import RefusedError
from rce_client.topics import Publisher

pytestmark = [pytest.mark.e2e]

STRING = "std_msgs/String"


@contextlib.asynccontextmanager
async def machine(engine: Engine, name: str, *options: object) -> AsyncIterator[Program]:
    """Run one more container task set that takes itself to be on a machine of its own."""
    program = engine._program(
        "rce-container",
        "127.0.0.1",
        *("--control-port", engine.control_port, "--link-port", 0, "--machine", name, "--name", name),
        *("--state-dir", engine.folder / name, "--runtime", engine.runtime, "--dev", *options),
        name=name,
    )
    await program.start()
    try:
        yield program
    finally:
        await program.stop()


def change(engine: Engine, method: str, path: str, body: dict[str, Any] | None = None) -> tuple[int, str]:
    """Use the REST API; returns the status and the text of the answer."""
    request = urllib.request.Request(
        f"{engine.url}api/v1{path}",
        method=method,
        data=None if body is None else json.dumps(body).encode(),
        headers={"Authorization": f"Bearer {engine.token()}", "Content-Type": "application/json"},
    )
    try:
        with urllib.request.urlopen(request, timeout=10) as reply:
            return reply.status, reply.read().decode()
    except urllib.error.HTTPError as error:
        return error.code, error.read().decode()


def container(engine: Engine, tag: str) -> dict[str, Any]:
    found = engine.get("/api/v1/containers")["containers"]
    return next((c for c in found if c["tag"] == tag), {"machine": "", "state": ""})


def machines(engine: Engine) -> dict[str, dict[str, Any]]:
    return {m["machine"]: m for m in engine.get("/api/v1/machines")["machines"] if m["kind"] == "container"}


async def wire_echo(
    conn: Connection, box: str
) -> tuple[Publisher[dict[str, Any]], asyncio.Queue[dict[str, Any]]]:
    await conn.add_node(box, "echo", "Test", "stringEcho.py", restart="on-failure")
    say = await conn.publisher("say", STRING)
    hear: asyncio.Queue[dict[str, Any]] = asyncio.Queue()
    await conn.subscriber("hear", STRING, hear.put_nowait)
    for tag, kind, topic in (
        ("say", "PublisherInterface", "/stringEchoReq"),
        ("hear", "SubscriberInterface", "/stringEchoResp"),
    ):
        await conn.add_interface(box, tag, kind, STRING, addr=topic)
        await conn.connect(f"{conn.robot_id}/{tag}", f"{box}/{tag}")
    return say, hear


async def echoes(
    conn: Connection, ends: tuple[Publisher[dict[str, Any]], asyncio.Queue[dict[str, Any]]], text: str
) -> None:
    """Wait until what is said comes back; a message that was under way while the container moved may not."""
    say, hear = ends
    async with asyncio.timeout(30):
        await conn.wait_active("say", 30)
        await conn.wait_active("hear", 30)
        while True:
            say.publish({"data": text})
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(1):
                    while (await hear.get())["data"] != text:
                        pass
                    return


async def test_containers_are_placed_resized_handed_over() -> None:
    """Containers find their machine are resized and handed over."""
    async with (
        running_engine() as engine,
        machine(engine, "m1", "--label", "gpu", "--slots", 2),
        Connection(engine.url, "testUser", "testUser", "rob") as conn,
    ):
        await until(lambda: "m1" in machines(engine), what="m1 is there")
        await conn.create_container("box", special_features=["gpu"])
        ends = await wire_echo(conn, "box")
        await echoes(conn, ends, "on the machine with the label")
        assert container(engine, "box")["machine"] == "m1"

        await conn.create_container("large", special_features=["gpu"], size=2)
        await until(lambda: any("m1 has 1 of 2 slots free, 2 needed" in text for text in conn.errors))
        status, text = change(
            engine, "POST", "/containers", {"tag": "large", "special_features": ["gpu"], "size": 2}
        )
        assert (status, "lacks the label gpu" in text) == (409, True)

        incarnation = container(engine, "box")["incarnation"]
        await conn.resize_container("box", size=2, cpu="50%")
        await until(lambda: container(engine, "box")["wish"]["size"] == 2)
        assert change(engine, "PATCH", "/containers/box", {"memory": "256M"}) == (204, "")
        status, text = change(engine, "PATCH", "/containers/box", {"size": 3})
        assert (status, "m1 has 2 of 2 slots free, 3 needed; nothing was changed" in text) == (409, True)
        await echoes(conn, ends, "larger, and the same as before")
        assert container(engine, "box")["incarnation"] == incarnation

        status, text = change(engine, "PUT", "/machines/m1/drain")
        staying = machines(engine)["m1"]["staying"]
        assert [item["container"] for item in staying] == ["testUser/box"]
        assert "lacks the label gpu" in staying[0]["why"]
        await echoes(conn, ends, "still where it was")
        async with machine(engine, "m2", "--label", "gpu", "--slots", 4):
            await until(lambda: container(engine, "box")["machine"] == "m2", timeout=30, what="it moved")
            await until(lambda: machines(engine)["m1"]["endpoints"] == 0)
            await echoes(conn, ends, "at the other machine")
            assert container(engine, "box")["state"] == "running"
            assert machines(engine)["m2"]["promised_slots"] == 2
            usage = await until(lambda: usage_of(engine, "box"), what="usage is told")
            assert usage["machine"] == "m2"
            await conn.remove_all()
            await until(lambda: not engine.get("/api/v1/containers")["containers"])


def usage_of(engine: Engine, tag: str) -> dict[str, Any] | None:
    found = [c for c in engine.get("/api/v1/usage")["containers"] if c["tag"] == tag and c["memory"]]
    return found[0] if found else None


async def test_a_new_password_ends_what_the_old_one_began() -> None:
    async with running_engine() as engine, Connection(engine.url, "testUser", "testUser", "rob") as conn:
        body = {"password": "new", "old_password": "testUser"}
        assert change(engine, "PUT", "/users/testUser/password", {"password": "new"})[0] == 422
        assert change(engine, "PUT", "/users/testUser/password", body) == (204, "")
        with pytest.raises(RefusedError, match="wrong password"):
            async with asyncio.timeout(60):
                await conn.wait_refused()
        async with Connection(engine.url, "testUser", "new", "rob"):
            pass
