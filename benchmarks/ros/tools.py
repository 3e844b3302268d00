"""ROS's command line tools at our core and at a rosmaster, in pairs."""

from __future__ import annotations

import contextlib
import os
import subprocess
import time
import xmlrpc.client
from collections.abc import Iterator, Mapping
from typing import Any

from benchmarks.ros.sides import SYSTEM_PYTHON, end

TARGET = 1.2
"""What a tool's time at our core may be at most, of its time at a rosmaster."""

COMMANDS = (
    "rosnode list",
    "rosnode info /talker",
    "rosnode ping -c 1 /talker",
    "rosnode ping -a",
    "rosnode cleanup",
    "rosnode machine",
    "rostopic list -v",
    "rostopic info /chatter",
    "rostopic type /chatter",
    "rostopic find std_msgs/String",
)
PROGRAM = """
import rospy
from std_msgs.msg import String
rospy.init_node("talker")
publisher = rospy.Publisher("chatter", String, queue_size=1)
print("ready", flush=True)
rospy.spin()
"""
DEAD = ("/dead", "/chatter", "std_msgs/String", "http://127.0.0.1:1/")
"""A node that is gone, for ``rosnode cleanup``."""


def tools(masters: Mapping[str, str], *, passes: int) -> list[dict[str, Any]]:
    """Run every tool at every master in turns; the fastest run of each counts."""
    best: dict[tuple[str, str], float] = {}
    with contextlib.ExitStack() as stack:
        for uri in masters.values():
            stack.enter_context(_talker(uri))
        for _ in range(passes):
            for command in COMMANDS:
                for name, uri in masters.items():
                    took = _run(command, uri)
                    best[command, name] = min(took, best.get((command, name), took))
    return [_row(command, {name: best[command, name] for name in masters}) for command in COMMANDS]


def _row(command: str, took: Mapping[str, float]) -> dict[str, Any]:
    row: dict[str, Any] = {"command": command} | {f"{name} ms": 1e3 * value for name, value in took.items()}
    if {"ours", "rosmaster"} <= took.keys():
        ratio = took["ours"] / took["rosmaster"]
        row |= {"ratio": round(ratio, 2), "target": TARGET, "": "" if ratio <= TARGET else "missed"}
    return row


def _run(command: str, uri: str) -> float:
    if command.endswith("cleanup"):
        xmlrpc.client.ServerProxy(uri).registerPublisher(*DEAD)
    began = time.perf_counter()
    subprocess.run(
        command.split(),
        env=_env(uri),
        input=b"y\n",
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        check=True,
    )
    return time.perf_counter() - began


@contextlib.contextmanager
def _talker(uri: str) -> Iterator[None]:
    process = subprocess.Popen(
        [SYSTEM_PYTHON, "-c", PROGRAM],
        env=_env(uri),
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    assert process.stdout is not None
    try:
        if "ready" not in process.stdout.readline():
            raise RuntimeError(f"no rospy node can be started at {uri}")
        yield
    finally:
        end(process)
        process.stdout.close()


def _env(uri: str) -> dict[str, str]:
    kept = {name: text for name, text in os.environ.items() if not name.startswith(("PYTHON", "ROS_"))}
    return kept | {"ROS_MASTER_URI": uri, "ROS_IP": "127.0.0.1", "PATH": "/usr/bin:/bin"}
