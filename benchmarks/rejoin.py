"""A container of a planner is made again: environment, interfaces, links, and a node that joins all robots.

Real processes without an engine: the environment is told what to make as by its manager, peers dial its links
as those of robots do, and the node registers each robot's topics as the planner does.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import os
import socket
import sys
import tempfile
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

import msgspec
import psutil
import uvloop

from benchmarks.figures import Results, show
from rce.control import EndpointKind, EndpointSpec
from rce.control.model import ConnectionSpec, LinkAddress, LinkSpec
from rce.link import Endpoint, Interface, LinkHub
from rce.model import EndpointId, InterfaceSpec, NodeSpec
from rce_container.environment import messages as m
from rce_container.environment.channel import Channel, connect

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

    from rce.link import Port

CONTAINER = "bench/planner"
MACHINE = "bench"
TOKEN = "rejoin"
GROUP = 50
"""Robots whose topics share a link of their robots and a link of their container."""
CELLS = "std_msgs/Int32MultiArray"
TOPICS = (
    ("amcl_pose", "geometry_msgs/PoseWithCovarianceStamped", "robots", "Publisher"),
    ("battery_state", "sensor_msgs/BatteryState", "robots", "Publisher"),
    ("moveClient/status", "fleet/MoveStatus", "clients", "Publisher"),
    ("goalNodesList", CELLS, "clients", "Subscriber"),
    ("cancelGoal", "std_msgs/Bool", "clients", "Subscriber"),
)
"""Of each robot: name, type, the peer, and what the container's end of the connection is."""
LIMIT_S = 600.0

_NODE = """#!/usr/bin/env python3
import asyncio, os, re, sys, time
from pathlib import Path
from rce.own_process import collect_all_seldom
from rce.ros.node import Node, run
from rce_fleet.nodes.graph_look import GraphLook
from rce_fleet.nodes.pose_publisher import PosePublisher
from rce_fleet.nodes.robot_topics import RobotTopics

async def main():
    count, done = int(sys.argv[1]), Path(sys.argv[2])
    collect_all_seldom()
    pattern = re.compile("/([^/]+)/amcl_pose")
    async with Node("fleet_planner") as node, GraphLook(node, 0.5) as graph:
        poses = PosePublisher(node)
        await poses.start()
        robots, names = RobotTopics(node, lambda event: None, poses, takes_answers=False), set()
        while len(names) < count:
            found = filter(None, map(pattern.fullmatch, (await graph.look()).publishers))
            new = {robot[1] for robot in found} - names
            await robots.join(new)
            names |= new
            if len(names) < count:
                await asyncio.sleep(graph.pause)
        for name in names:
            for topic in ("amcl_pose", "moveClient/status"):
                while not node._topics.inputs[f"/{name}/{topic}"].connected():
                    await asyncio.sleep(0.05)
            for topic in ("goalNodesList", "cancelGoal"):
                while not node._topics.outputs[f"/{name}/{topic}"].links:
                    await asyncio.sleep(0.05)
        part = done.with_suffix(".part")
        part.write_text(f"{time.process_time()}")
        part.rename(done)
        await node.spin()

run(main())
"""


class _Peer(Interface):
    """The other end of a connection: it takes what comes."""

    async def start(self) -> None:
        """Do nothing."""

    async def close(self) -> None:
        """Do nothing."""

    def receive(self, payload: bytes, *, latched: bool) -> None:
        """Take a message."""


async def measure(robots: int) -> dict[str, Any]:
    """Make a container of so many robots, and wait until all of them are connected."""
    with tempfile.TemporaryDirectory(prefix="rce-rejoin-") as name:
        folder = Path(name)
        for part in ("home", "logs", "packages"):
            (folder / part).mkdir()
        script = folder / "packages" / "rejoin" / "planner.py"
        script.parent.mkdir()
        (script.parent / "package.yaml").write_text("name: rejoin\npython: engine\n")
        script.write_text(_NODE)
        script.chmod(0o755)
        own, peers = _specs(robots, folder)
        begin = perf_counter()
        async with _environment(folder) as process, _peers(peers) as ends, _manager(folder, own) as counts:
            async with asyncio.timeout(LIMIT_S):
                await _until(lambda: sum(len(end.connections) for end in ends) == len(own.connections))
                linked = perf_counter() - begin
                await _until((folder / "done").exists)
            spent = process.cpu_times()
            return {
                "robots": robots,
                "interfaces connected s": round(linked, 1),
                "robots joined s": round(perf_counter() - begin, 1),
                "environment cpu_s": round(spent.user + spent.system, 2),
                "node cpu_s": round(float((folder / "done").read_text()), 2),
                "environment MB": round(process.memory_info().rss / 1e6),
                "environment files": process.num_fds(),
                **counts,
            }


async def _until(holds: Callable[[], bool]) -> None:
    while not holds():  # noqa: ASYNC110 - other processes
        await asyncio.sleep(0.05)


def _specs(robots: int, folder: Path) -> tuple[EndpointSpec, list[EndpointSpec]]:
    """Return what the environment and each of its peers are to make."""
    interfaces: list[InterfaceSpec] = []
    connections: dict[str, list[ConnectionSpec]] = {}
    theirs: dict[str, list[InterfaceSpec]] = {}
    for robot in range(robots):
        for topic, message_type, side, kind in TOPICS:
            number, link = len(interfaces) + 1, f"{side}{robot // GROUP}"
            tag, address = f"i{number}", f"/Robot{robot + 1}/{topic}"
            interfaces.append(
                InterfaceSpec(tag=tag, type=f"{kind}Interface", message_type=message_type, addr=address)
            )
            other = "Subscriber" if kind == "Publisher" else "Publisher"
            theirs.setdefault(link, []).append(
                InterfaceSpec(tag=tag, type=f"{other}Forwarder", message_type=message_type, addr=address)
            )
            connections.setdefault(link, []).append(
                ConnectionSpec(id=number, link=link, interface=tag, peer_interface=tag)
            )
    done = folder / "done"
    own = EndpointSpec(
        id=CONTAINER,
        kind=EndpointKind.CONTAINER,
        revision=1,
        interfaces=tuple(interfaces),
        links=tuple(LinkSpec(id=link, peer=f"bench/{link}", token=TOKEN, dial=False) for link in connections),
        connections=tuple(one for ends in connections.values() for one in ends),
        nodes=(NodeSpec(tag="planner", pkg="rejoin", exe="planner.py", args=f"{robots} {done}"),),
    )
    place = LinkAddress(machine=MACHINE, unix=str(folder / "links"))
    return own, [
        EndpointSpec(
            id=f"bench/{link}",
            kind=EndpointKind.ROBOT,
            revision=1,
            interfaces=tuple(theirs[link]),
            links=(LinkSpec(id=link, peer=CONTAINER, token=TOKEN, dial=True, address=place),),
            connections=tuple(ends),
        )
        for link, ends in connections.items()
    ]


@contextlib.asynccontextmanager
async def _environment(folder: Path) -> AsyncIterator[psutil.Process]:
    """Run an environment that a manager can connect to; it ends with the block."""
    import rce_container
    import rce_fleet

    shares = [str(Path(package.__path__[0]) / "share") for package in (rce_fleet, rce_container)]
    boot = m.Boot(
        id=CONTAINER,
        mark=f"rejoin-{os.getpid()}",
        machine=MACHINE,
        home=str(folder / "home"),
        logs=str(folder / "logs"),
        ros_port=0,
        isolated=False,
        packages=(str(folder / "packages"), *shares),
        interrupt_timeout=2.0,
    )
    with contextlib.ExitStack() as stack:
        listeners = []
        for name in ("control", "links"):
            listener = stack.enter_context(socket.socket(socket.AF_UNIX))
            listener.bind(str(folder / name))
            listener.listen(512)
            listeners.append(listener)
        control, links = listeners
        process = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "rce_container.environment", msgspec.json.encode(boot).decode()),
            stdin=control.fileno(),
            stdout=links.fileno(),
            stderr=asyncio.subprocess.DEVNULL,
        )
    try:
        yield psutil.Process(process.pid)
    finally:
        if process.returncode is None:
            process.terminate()
        await process.wait()


@contextlib.asynccontextmanager
async def _manager(folder: Path, spec: EndpointSpec) -> AsyncIterator[dict[str, int]]:
    """Tell the environment what to make, and count what it reports."""
    channel = await connect(str(folder / "control"))
    counts = {"reports": 0, "report bytes": 0, "faults": 0}
    ours, theirs = socket.socketpair()
    with ours, theirs:
        channel.send(m.encode(m.Handover(features=("patches",))), theirs.fileno())
        channel.send(m.encode(m.Apply(spec=spec)))
        reading = asyncio.create_task(_count(channel, counts))
        try:
            yield counts
        finally:
            reading.cancel()
            channel.close()


async def _count(channel: Channel, counts: dict[str, int]) -> None:
    while (line := await channel.receive()) is not None:
        counts["reports"] += 1
        counts["report bytes"] += len(line)
        counts["faults"] += isinstance(m.decode_to_manager(line), m.Fault)


@contextlib.asynccontextmanager
async def _peers(specs: list[EndpointSpec]) -> AsyncIterator[list[Endpoint]]:
    """Run the endpoints at the other ends of the environment's links."""

    def make(port: Port) -> Interface:
        return _Peer(port)

    hub = LinkHub(MACHINE)
    ends = []
    try:
        for spec in specs:
            end = Endpoint(EndpointId.parse(spec.id), make, hub, on_change=lambda: None, on_fault=print)
            ends.append(end)
            await end.apply(spec)
        yield ends
    finally:
        for end in ends:
            await end.close()
        await hub.close()


def main() -> None:
    """Read the command line and measure."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.rejoin", description=__doc__)
    parser.add_argument("--robots", type=int, nargs="+", default=[100, 1000], help="numbers of robots")
    results = Results("rejoin")
    rows = [uvloop.run(measure(robots)) for robots in parser.parse_args().robots]
    show("A planner's container that is made again", rows)
    results.keep("rejoin", rows)
    print("results:", results.save())


if __name__ == "__main__":
    main()
