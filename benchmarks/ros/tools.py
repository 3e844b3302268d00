"""ROS's command line tools at our core and at a rosmaster, in pairs."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import time
import xmlrpc.client
from collections.abc import Iterator, Mapping
from typing import Any

from benchmarks.ros.sides import SYSTEM_PYTHON, end

LONGEST_S = 300.0
TARGET = 1.2
"""The maximum of a tool's time at our core, relative to its time at a rosmaster."""

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
import sys
import rospy
from std_msgs.msg import String
rospy.init_node(sys.argv[1])
publisher = rospy.Publisher("chatter", String, queue_size=1)
print("ready", flush=True)
rospy.spin()
"""
TALKERS = ("talker", "talker2", "talker3")
STOPPED = "stopped"
DEAD = {
    "/closed": "http://127.0.0.1:1/",
    "/lost": "http://no-such-robot.invalid:4711/",
}
"""Nodes that are gone: nothing listens at the one's port, the other one's host name does not exist."""


def tools(masters: Mapping[str, str], *, passes: int) -> list[dict[str, Any]]:
    """Run every tool at every master in turns; the fastest run of each counts.

    First with some nodes; then with others beside them that do not answer: gone, and stopped (SIGSTOP).
    """
    with contextlib.ExitStack() as stack:
        for uri in masters.values():
            for name in TALKERS:
                stack.enter_context(_talker(uri, name))
        rows = _measure(masters, {}, "alive", passes)
        dead = {uri: dict(DEAD) for uri in masters.values()}
        for uri, nodes in dead.items():
            process = stack.enter_context(_talker(uri, STOPPED))
            master: Any = xmlrpc.client.ServerProxy(uri)  # a call gives any value
            nodes[f"/{STOPPED}"] = master.lookupNode("/bench", f"/{STOPPED}")[2]
            process.send_signal(signal.SIGSTOP)
            stack.callback(process.send_signal, signal.SIGCONT)
        rows += _measure(masters, dead, f"{1 + len(DEAD)} do not answer", passes)
    return rows


def _measure(
    masters: Mapping[str, str], dead: Mapping[str, Mapping[str, str]], nodes: str, passes: int
) -> list[dict[str, Any]]:
    best: dict[tuple[str, str], float] = {}
    for _ in range(passes):
        for command in COMMANDS:
            for name, uri in masters.items():
                for node, address in dead.get(uri, {}).items():  # a cleanup has removed them
                    _register(uri, node, address)
                if command.endswith("cleanup") and not dead:
                    _register(uri, "/closed", DEAD["/closed"])
                took = _run(command, uri)
                best[command, name] = min(took, best.get((command, name), took))
    return [
        {"nodes": nodes} | _row(command, {name: best[command, name] for name in masters})
        for command in COMMANDS
    ]


def _register(uri: str, node: str, address: str) -> None:
    xmlrpc.client.ServerProxy(uri).registerPublisher(node, "/chatter", "std_msgs/String", address)


def _row(command: str, took: Mapping[str, float]) -> dict[str, Any]:
    row: dict[str, Any] = {"command": command} | {f"{name} ms": 1e3 * value for name, value in took.items()}
    if {"ours", "rosmaster"} <= took.keys():
        ratio = took["ours"] / took["rosmaster"]
        row |= {"ratio": round(ratio, 2), "target": TARGET, "": "" if ratio <= TARGET else "missed"}
    return row


def _run(command: str, uri: str) -> float:
    began = time.perf_counter()
    # Some end with 1 where a node does not answer. Output is read, because a wait without pipes polls.
    subprocess.run(
        command.split(),
        env=_env(uri),
        input=b"y\n",
        capture_output=True,
        check=False,
        timeout=LONGEST_S,
    )
    return time.perf_counter() - began


@contextlib.contextmanager
def _talker(uri: str, name: str) -> Iterator[subprocess.Popen[str]]:
    process = subprocess.Popen(
        [SYSTEM_PYTHON, "-c", PROGRAM, name],
        env=_env(uri),
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    assert process.stdout is not None
    try:
        if "ready" not in process.stdout.readline():
            raise RuntimeError(f"no rospy node can be started at {uri}")
        yield process
    finally:
        end(process)
        process.stdout.close()


def _env(uri: str) -> dict[str, str]:
    kept = {name: text for name, text in os.environ.items() if not name.startswith(("PYTHON", "ROS_"))}
    return kept | {"ROS_MASTER_URI": uri, "ROS_IP": "127.0.0.1", "PATH": "/usr/bin:/bin"}
