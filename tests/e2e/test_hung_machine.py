"""A container whose machine hangs is made elsewhere; what still runs there has no part in its links."""

from __future__ import annotations

import asyncio
import signal
import sys
import time
from pathlib import Path

import psutil
import pytest
from support.engine import running_engine, until

from rce_client import Connection

pytestmark = [pytest.mark.e2e, pytest.mark.timeout(600)]

TIMEOUT_S = 200.0
WATCH_S = 5.0
SAY = f"""#!{sys.executable}
import os

from rce.ros.node import Node, run


async def main():
    async with Node("say") as node:
        said = await node.advertise("say", "std_msgs/String")
        while await node.sleep(0.05):
            said.publish(data=str(os.getpid()))


run(main())
"""


def package(folder: Path) -> Path:
    """A folder of packages with a node that says its pid, twenty times a second."""
    own = folder / "packages" / "pids"
    own.mkdir(parents=True)
    (own / "package.xml").write_text("<package><name>pids</name></package>")
    (own / "say.py").write_text(SAY)
    (own / "say.py").chmod(0o755)
    return own.parent


async def test_containers_of_a_hung_machine_keep_no_links(tmp_path: Path) -> None:
    """``a`` dials ``b``, also where it still runs, under a task set that hangs."""
    async with running_engine(machines=2, packages=package(tmp_path)) as engine:
        machines = dict(zip(("machine0", "machine1"), engine.machines, strict=True))

        def place(tag: str) -> str:
            found = engine.get("/api/v1/containers")["containers"]
            return next((str(one["machine"]) for one in found if one["tag"] == tag), "")

        async with Connection(engine.url, "testUser", "testUser", "rob") as robot:
            heard: list[tuple[float, int]] = []
            await robot.subscriber(
                "hear", "std_msgs/String", lambda msg: heard.append((time.monotonic(), int(msg["data"])))
            )
            await robot.create_container("a")
            await robot.create_container("b")
            await until(lambda: place("a") and place("b"), timeout=TIMEOUT_S, what="both are placed")
            assert place("a") != place("b")
            await robot.add_node("a", "say", "pids", "say.py")
            await robot.add_node("b", "echo", "Test", "stringEcho.py")
            await robot.add_interface("a", "out", "SubscriberInterface", "std_msgs/String", addr="/say")
            await robot.add_interface(
                "b", "in", "PublisherInterface", "std_msgs/String", addr="/stringEchoReq"
            )
            await robot.add_interface(
                "b", "told", "SubscriberInterface", "std_msgs/String", addr="/stringEchoResp"
            )
            await robot.connect("a/out", "b/in")
            await robot.connect("b/told", "rob/hear")
            await until(lambda: heard, timeout=TIMEOUT_S, what="the robot hears the node of a")
            (_, former) = heard[-1]
            hung = machines[place("a")]
            assert hung.process is not None
            hung.process.send_signal(signal.SIGSTOP)
            try:
                await until(lambda: heard[-1][1] != former, timeout=TIMEOUT_S, what="a is made elsewhere")
                since = time.monotonic()
                await asyncio.sleep(WATCH_S)
                texts = [pid for at, pid in heard if at > since]
            finally:
                hung.process.send_signal(signal.SIGCONT)
            assert former not in texts, f"{texts.count(former)} of {len(texts)} are of the former place"
            assert len(texts) > WATCH_S / 0.05 / 4
            await until(
                lambda: not psutil.pid_exists(former), what="the container ends at its former machine"
            )
