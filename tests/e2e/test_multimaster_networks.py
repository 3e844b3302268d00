"""Three machines in network namespaces, each with a core, a discovery and a synchronization of its own."""

from __future__ import annotations

import asyncio
import os
import sys
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager
from pathlib import Path

import pytest
from support.engine import Program, until
from support.networks import NetworkMachine, network

pytestmark = [pytest.mark.e2e, pytest.mark.needs("root", "netns")]

TALKER = """
import asyncio, sys
from rce.ros.node import Node, run
async def main():
    async with Node("talker", argv=[]) as node:
        publisher = await node.advertise("/" + sys.argv[1] + "/pose", "std_msgs/String")
        await node.advertise("/" + sys.argv[1] + "/secret", "std_msgs/String")
        number = 0
        print("talker ready", flush=True)
        while await node.sleep(0.1):
            number += 1
            publisher.publish(data=f"{sys.argv[1]} {number}")
run(main())
"""

LISTENER = """
import os, sys
from rce.ros.node import Node, run
async def main():
    name = "listener_" + os.environ["ROS_IP"].replace(".", "_")
    async with Node(name, argv=[]) as node:
        await node.subscribe(sys.argv[1], "std_msgs/String", lambda m: print("heard", m.data, flush=True))
        print("listener ready", flush=True)
        await node.spin()
run(main())
"""

ROSPY_LISTENER = """
import rospy, sys
from std_msgs.msg import String
rospy.init_node("listener")
rospy.Subscriber(sys.argv[1], String, lambda m: print("heard", m.data, flush=True))
print("listener ready", flush=True)
rospy.spin()
"""


class Machine:
    """What runs on one machine."""

    def __init__(self, place: NetworkMachine, folder: Path, stack: AsyncExitStack) -> None:
        self.place = place
        self.folder = folder
        self._stack = stack
        kept = {key: value for key, value in os.environ.items() if not key.startswith(("RCE_", "ROS_"))}
        self.address = place.address
        self.env = kept | {"HOME": str(folder)}
        self.hide_at(place.address)

    def hide_at(self, address: str) -> None:
        """Let cores and nodes tell others an address of their own."""
        self.address = address
        self.env |= {"ROS_MASTER_URI": f"http://{address}:11311/", "ROS_IP": address}

    async def start(self, name: str, argv: list[str], *, ready: str, real: bool = False) -> Program:
        env = self.env
        if real:
            env = {key: value for key, value in env.items() if not key.startswith(("PYTHON", "VIRTUAL_ENV"))}
            env["PATH"] = "/usr/bin:/bin"
        program = Program(f"{name}-{self.place.address}", [*self.place.prefix, *argv], env, self.folder)
        self._stack.push_async_callback(_end, program)
        await program.start(ready=ready)
        return program

    async def python(self, name: str, text: str, *arguments: str, ready: str) -> Program:
        return await self.start(name, [sys.executable, "-c", text, *arguments], ready=ready)

    async def rce(self, command: str, *options: str, ready: str) -> Program:
        return await self.python(command, _command(command), *options, ready=ready)

    async def join(self, *chosen: str) -> tuple[Program, Program]:
        """Start discovery and synchronization with their defaults."""
        discovery = await self.rce("discovery", ready="rce discovery ready")
        return discovery, await self.rce("sync", *chosen, "-v", ready="rce sync ready")

    async def core(self) -> Program:
        return await self.rce("core", "--bind", "0.0.0.0", "--advertised", self.address, ready="ready:")

    async def listing(self) -> dict[str, str]:
        """What ``rce discovery --list`` says: name to state."""
        argv = [*self.place.prefix, sys.executable, "-c", _command("discovery"), "--list"]
        program = await asyncio.create_subprocess_exec(
            *argv, env=self.env, stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.PIPE
        )
        output, errors = await program.communicate()
        assert program.returncode == 0, errors.decode()
        rows = [line.split() for line in output.decode().splitlines()]
        return {name: state for name, state, *_ in rows}


def _command(name: str) -> str:
    return f"import typer; from rce.ros.cli.{name} import {name}; typer.run({name})"


async def _end(program: Program) -> None:
    if program.running:
        await program.kill()


@asynccontextmanager
async def machines(count: int, folder: Path) -> AsyncIterator[list[Machine]]:
    with network(count) as places:
        async with AsyncExitStack() as stack:
            yield [Machine(place, folder, stack) for place in places]


async def hears(listener: Program, *, timeout: float = 90) -> None:
    """Wait until a listener hears something that it has not heard yet."""
    before = listener.output().count("heard")
    await until(
        lambda: listener.output().count("heard") > before + 3, timeout=timeout, what=listener.output()[-500:]
    )


async def test_three_machines_survive_a_network_drop(folder: Path) -> None:
    """Three machines find each other and survive a network drop."""
    async with machines(3, folder) as (robot, station, other):
        for machine in (robot, station, other):
            await machine.core()
            await machine.join("--topics", "/Robot1/pose")
        await robot.python("talker", TALKER, "Robot1", ready="talker ready")
        listeners = [
            await machine.python("listener", LISTENER, "/Robot1/pose", ready="listener ready")
            for machine in (station, other)
        ]
        for listener in listeners:
            await hears(listener)
        everybody = {machine.place.address for machine in (robot, station, other)}
        assert await other.listing() == dict.fromkeys(everybody, "online")
        log = (folder / f"sync-{station.place.address}.log").read_text()
        assert "/Robot1/pose" in log
        assert "/Robot1/secret" not in log

        for drop, back in (
            (robot.place.unplug, robot.place.plug),
            (robot.place.interface_down, robot.place.interface_up),
        ):
            drop()

            async def robot_is(state: str) -> bool:
                return (await station.listing())[robot.place.address] == state

            await until(lambda: robot_is("offline"), what="the loss is noticed")
            assert (await station.listing())[other.place.address] == "online"
            back()
            await until(lambda: robot_is("online"), what="the return is noticed")
            for listener in listeners:
                await hears(listener)


@pytest.mark.needs("rospy")
async def test_a_real_master_with_rospy_survives_a_network_drop(folder: Path) -> None:
    async with machines(2, folder) as (robot, station):
        await robot.core()
        await robot.join()
        master = ["/usr/bin/python3", "-u", "/usr/bin/rosmaster", "--core", "-p", "11311"]
        await station.start("rosmaster", master, ready="", real=True)
        await station.join()
        await robot.python("talker", TALKER, "Robot1", ready="talker ready")
        argv = ["/usr/bin/python3", "-c", ROSPY_LISTENER, "/Robot1/pose"]
        listener = await station.start("listener", argv, ready="listener ready", real=True)
        await hears(listener)
        robot.place.unplug()

        async def robot_is(state: str) -> bool:
            return (await station.listing())[robot.place.address] == state

        await until(lambda: robot_is("offline"), what="the loss is noticed")
        robot.place.plug()
        await until(lambda: robot_is("online"), what="the return is noticed")
        await hears(listener, timeout=60)


async def test_relay_needs_one_connection_only(folder: Path) -> None:
    """Cores and nodes have addresses to which only their own machine knows a way, as behind a NAT."""
    async with machines(2, folder) as (robot, cloud):
        for machine, private in ((robot, "10.99.1.1"), (cloud, "10.99.2.1")):
            machine.place.add_private_address(private)
            machine.hide_at(private)
        for machine, other in ((robot, cloud), (cloud, robot)):
            assert not machine.place.has_way_to(other.address)
        await robot.core()
        await cloud.core()
        token = ("--relay-token", "shared")
        await cloud.rce("sync", "--relay-listen", "11911", *token, ready="rce sync ready")
        await robot.rce("sync", "--relay", cloud.place.address, *token, ready="rce sync ready")
        await robot.python("talker", TALKER, "Robot1", ready="talker ready")
        listener = await cloud.python("listener", LISTENER, "/Robot1/pose", ready="listener ready")
        await hears(listener)
        robot.place.unplug()
        await until(lambda: "fell silent" in (folder / f"sync-{cloud.place.address}.log").read_text())
        robot.place.plug()
        await hears(listener)
