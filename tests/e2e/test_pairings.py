"""Every pairing of endpoints through a real engine: unix sockets and TCP, topics and services, both ways."""

from __future__ import annotations

import asyncio
import contextlib
import json
import re
import sys
from collections.abc import AsyncIterator
from hashlib import sha256
from pathlib import Path
from urllib.parse import urlencode

import pytest
import pytest_asyncio
from support.engine import Engine, Program, running_engine, until
from support.stranger import Stranger, stranger
from websockets.asyncio.client import connect
from websockets.exceptions import InvalidStatus

from rce.ros.core import Core

pytestmark = [pytest.mark.e2e, pytest.mark.asyncio(loop_scope="module")]

ONE_PROCESS = "one robot process"
ONE_MACHINE = pytest.param("one machine", marks=pytest.mark.needs("bwrap"))
TWO_MACHINES = pytest.param("two machines", marks=pytest.mark.needs("bwrap"))
STRING = "std_msgs/String"
ECHO = "Test/StringEcho"


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def shared_engine(request: pytest.FixtureRequest) -> AsyncIterator[Engine]:
    """Endpoints in one process, or in several that reach each other by unix sockets, or by TCP."""
    if request.param == ONE_PROCESS:
        running = running_engine()
    else:
        running = running_engine(runtime="namespace", robots=2, apart=request.param == "two machines")
    async with running as engine:
        yield engine


@pytest_asyncio.fixture(autouse=True, loop_scope="module")
async def _no_robots(shared_engine: Engine) -> None:
    await until(shared_engine.has_no_robots, what="the robots of other tests left")


def of(*engines: object) -> pytest.MarkDecorator:
    """Run a test with these engines."""
    return pytest.mark.parametrize("shared_engine", engines, indirect=True, scope="module")


def interface(endpoint: str, tag: str, kind: str, cls: str = STRING, addr: str = "") -> dict[str, str]:
    made = {"endpointTag": endpoint, "interfaceTag": tag, "interfaceType": kind, "className": cls}
    return made | ({"addr": addr} if addr else {})


@contextlib.asynccontextmanager
async def two_robots(engine: Engine) -> AsyncIterator[tuple[Stranger, Stranger]]:
    """Two robots, at different robot processes if there are two."""
    async with stranger(engine.url, robot="first") as first, stranger(engine.url, robot="second") as second:
        ports = {robot.socket.get_extra_info("peername")[1] for robot in (first, second)}
        assert len(ports) == len(engine.robots), "the robots were not spread over the processes"
        yield first, second


async def wire_robots(first: Stranger, second: Stranger) -> None:
    await first.send(
        "CN",
        {
            "addInterfaces": [
                interface("first", "out", "SubscriberConverter"),
                interface("second", "in", "PublisherConverter"),
                interface("first", "ask", "ServiceProviderConverter", ECHO),
                interface("second", "answer", "ServiceClientConverter", ECHO),
            ]
        },
    )
    pairs = [("first/out", "second/in"), ("second/answer", "first/ask")]
    await first.send("CX", {"connect": [{"tagA": a, "tagB": b} for a, b in pairs]})
    await first.wait_status({"out": True, "ask": True})
    await second.wait_status({"in": True, "answer": True})


async def answer_calls(robot: Stranger, count: int) -> None:
    """Answer service calls, the last one first: each must find its caller all the same."""
    calls = [await robot.queue("answer").get() for _ in range(count)]
    for call in reversed(calls):
        text = call["msg"]["data"]
        reply = {"iTag": "answer", "type": ECHO, "msgID": call["msgID"], "msg": {"data": f"re: {text}"}}
        await robot.send("DM", reply)


async def check_robots(first: Stranger, second: Stranger) -> None:
    for size in (0, 100, 3_000_000):
        await first.publish("out", STRING, {"data": "x" * size})
        assert len((await second.receive("in"))["data"]) == size
    texts = [f"question {number}" for number in range(5)]
    answering = asyncio.create_task(answer_calls(second, len(texts)))
    for number, text in enumerate(texts):
        await first.send("DM", {"iTag": "ask", "type": ECHO, "msgID": f"n{number}", "msg": {"data": text}})
    answers = [await first.queue("ask").get() for _ in texts]
    await answering
    assert {a["msgID"]: a["msg"]["data"] for a in answers} == {
        f"n{n}": f"re: {t}" for n, t in enumerate(texts)
    }


@of(ONE_PROCESS, ONE_MACHINE, TWO_MACHINES)
async def test_robot_with_robot(shared_engine: Engine) -> None:
    async with two_robots(shared_engine) as (first, second):
        await wire_robots(first, second)
        await check_robots(first, second)


@of(ONE_MACHINE)
async def test_provider_that_dies_answers_its_callers_with_an_error(shared_engine: Engine) -> None:
    async with stranger(shared_engine.url, robot="first") as first:
        async with stranger(shared_engine.url, robot="second") as second:
            await wire_robots(first, second)
            await first.send("DM", {"iTag": "ask", "type": ECHO, "msgID": "n1", "msg": {"data": "anybody?"}})
            await second.queue("answer").get()
        await first.wait_error("n1")


@of(ONE_PROCESS, ONE_MACHINE, TWO_MACHINES)
async def test_container_with_container_and_with_robot(shared_engine: Engine) -> None:
    """The robot's words go to the echo node of container a, on to that of container b, and back."""
    async with stranger(shared_engine.url) as robot:
        for tag in ("a", "b"):
            await robot.send("CC", {"containerTag": tag})
        nodes = [
            {"containerTag": tag, "nodeTag": "echo", "pkg": "Test", "exe": "stringEcho.py"}
            for tag in ("a", "b")
        ]
        await robot.send(
            "CN",
            {
                "addNodes": nodes,
                "addInterfaces": [
                    interface("testRobot", "say", "SubscriberConverter"),
                    interface("a", "say", "PublisherInterface", addr="/stringEchoReq"),
                    interface("a", "onward", "SubscriberInterface", addr="/stringEchoResp"),
                    interface("b", "request", "PublisherInterface", addr="/stringEchoReq"),
                    interface("b", "response", "SubscriberInterface", addr="/stringEchoResp"),
                    interface("testRobot", "hear", "PublisherConverter"),
                    interface("b", "service", "ServiceClientInterface", ECHO, "/stringEchoService"),
                    interface("a", "service", "ServiceProviderInterface", ECHO, "/served_by_b"),
                    interface("a", "local", "ServiceClientInterface", ECHO, "/served_by_b"),
                    interface("testRobot", "ask", "ServiceProviderConverter", ECHO),
                ],
            },
        )
        pairs = [
            ("testRobot/say", "a/say"),
            ("a/onward", "b/request"),
            ("b/response", "testRobot/hear"),
            ("a/service", "b/service"),
            ("testRobot/ask", "a/local"),
        ]
        await robot.send("CX", {"connect": [{"tagA": x, "tagB": y} for x, y in pairs]})
        await robot.wait_status({"say": True, "hear": True, "ask": True})
        # The robot's own interfaces say nothing of the connection between the containers.
        await until(
            lambda: all(
                one["established"] for one in shared_engine.get("/api/v1/connections")["connections"]
            ),
            what="all connections are established",
        )
        assert await robot.call("ask", ECHO, {"data": "over two containers"}) == {
            "data": "over two containers"
        }
        await robot.publish("say", STRING, {"data": "hello"})
        assert await robot.receive("hear") == {"data": "hello"}
        assert robot.errors == []


@of(ONE_MACHINE)
async def test_who_has_a_robot_id_is_told_to_its_user(shared_engine: Engine) -> None:
    """At whichever robot process the second client tries to come in; by ``rce-ros`` in a line of its own."""
    query = urlencode(
        {"userID": "testUser", "robotID": "holder", "password": sha256(b"testUser").hexdigest()}
    )
    holder = r"connected already, from 127\.0\.0\.1 since \d{4}-\d\d-\d\d \d\d:\d\d:\d\d UTC"
    engine = shared_engine
    async with stranger(engine.url, robot="holder"):
        for port, _ in engine.robot_ports:
            with pytest.raises(InvalidStatus) as caught:
                await connect(f"ws://127.0.0.1:{port}/?{query}", proxy=None)
            assert caught.value.response.status_code == 409
            assert re.search(holder, bytes(caught.value.response.body or b"").decode())
        file = engine.folder / "robot.config"
        login = {"url": engine.url, "userID": "testUser", "password": "testUser", "robotID": "holder"}
        file.write_text(json.dumps(login))
        async with Core("127.0.0.1", 0) as core:
            program = str(Path(sys.executable).parent / "rce-ros")
            bridge = Program("rce-ros", [program, str(file)], engine.env, engine.folder)
            bridge.env = {**engine.env, "ROS_MASTER_URI": core.uri}
            await bridge.start(ready="waiting until it is free")
            assert re.search(holder, bridge.output())
            await until(lambda: bridge.output().count("until it is free") > 1, what="it is said again")
            await bridge.stop()


@of(ONE_PROCESS)
async def test_interfaces_of_one_endpoint_connect_both_ways(shared_engine: Engine) -> None:
    """As in the original engine: a robot with itself, a container with itself, and no echo of a bridge."""
    async with (
        stranger(shared_engine.url, robot="one") as first,
        stranger(shared_engine.url, robot="other") as second,
    ):
        await first.send("CC", {"containerTag": "box"})
        node = {"containerTag": "box", "nodeTag": "echo", "pkg": "Test", "exe": "stringEcho.py"}
        await first.send(
            "CN",
            {
                "addNodes": [node],
                "addInterfaces": [
                    interface("one", "out", "SubscriberConverter"),
                    interface("one", "in", "PublisherConverter"),
                    interface("box", "there", "PublisherInterface", addr="/relay"),
                    interface("box", "back", "SubscriberInterface", addr="/relay"),
                    interface("box", "from", "SubscriberInterface", addr="/stringEchoResp"),
                    interface("box", "to", "PublisherInterface", addr="/relay"),
                    interface("box", "request", "PublisherInterface", addr="/stringEchoReq"),
                    interface("other", "request", "SubscriberConverter"),
                    interface("other", "own_out", "SubscriberConverter"),
                    interface("other", "own_in", "PublisherConverter"),
                    interface("other", "own_ask", "ServiceProviderConverter", ECHO),
                    interface("other", "answer", "ServiceClientConverter", ECHO),
                    interface("box", "response", "SubscriberInterface", addr="/stringEchoResp"),
                ],
            },
        )
        pairs = [
            ("one/out", "box/there"),
            ("one/in", "box/back"),
            ("one/in", "box/response"),
            ("box/from", "box/to"),
            ("other/request", "box/request"),
            ("other/own_in", "other/own_out"),
            ("other/own_ask", "other/answer"),
        ]
        await first.send("CX", {"connect": [{"tagA": a, "tagB": b} for a, b in pairs]})
        await first.wait_status({"out": True, "in": True})
        await second.wait_status({"own_in": True, "own_out": True, "own_ask": True, "request": True})
        await until(
            lambda: all(
                one["established"] for one in shared_engine.get("/api/v1/connections")["connections"]
            ),
            what="all connections are established",
        )
        await second.publish("own_out", STRING, {"data": "to myself"})
        assert await second.receive("own_in") == {"data": "to myself"}
        answering = asyncio.create_task(answer_calls(second, 1))
        assert await second.call("own_ask", ECHO, {"data": "myself"}) == {"data": "re: myself"}
        await answering
        await first.publish("out", STRING, {"data": "own words"})
        await second.publish("request", STRING, {"data": "a node's words"})
        assert await first.receive("in") == {"data": "a node's words"}
        assert first.queue("in").empty(), "neither its own words nor those of another interface come back"
        assert first.errors == second.errors == []
