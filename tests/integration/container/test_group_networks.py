"""Networks of groups with real containers: who reaches whom, who does not, and what is left."""

from __future__ import annotations

import json
import os
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest
from support.containers import Machine, is_in, until

from rce.control.messages import Fault
from rce.control.model import EndpointState, NodeState
from rce.model.specs import Network, NodeSpec, Resources
from rce_container.exceptions import NetworkError
from rce_container.network.namespaces import open_namespace

pytestmark = pytest.mark.needs("root", "bwrap", "netns")

PORT = 5000
NODES = {
    "serve.py": (
        "import socket\n"
        f"server = socket.create_server(('', {PORT}))\n"
        "print('serving', flush=True)\n"
        "while True:\n"
        "    peer, address = server.accept()\n"
        "    peer.sendall(address[0].encode())\n"
        "    peer.close()\n"
    ),
    "reach.py": (
        "import concurrent.futures, json, os, socket, sys\n"
        "def reach(target):\n"
        "    host, port = target.rsplit(':', 1)\n"
        "    try:\n"
        "        with socket.create_connection((host, int(port)), 2) as peer:\n"
        "            return peer.recv(100).decode()\n"
        "    except OSError as error:\n"
        "        return ''\n"
        "with concurrent.futures.ThreadPoolExecutor(40) as pool:\n"
        "    found = dict(zip(sys.argv[1:], pool.map(reach, sys.argv[1:])))\n"
        "interfaces = [name for _, name in socket.if_nameindex()]\n"
        "six = '/proc/net/if_inet6'\n"
        "addresses = open(six).read().split() if os.path.exists(six) else []\n"
        "print(json.dumps({'found': found, 'interfaces': interfaces, 'six': addresses[5::6],\n"
        "                  'servers': os.path.exists('/etc/resolv.conf'),\n"
        "                  'hosts': open('/etc/hosts').read(), 'ip': os.environ['ROS_IP']}), flush=True)\n"
    ),
    "speak.py": (
        "import asyncio\n"
        "from rce.ros.node import Node, run\n"
        "async def main():\n"
        "    async with Node('speaker') as node:\n"
        "        publisher = await node.advertise('words', 'std_msgs/String', latch=True)\n"
        "        publisher.publish({'data': 'through the group'})\n"
        "        print('spoken', flush=True)\n"
        "        await node.spin()\n"
        "run(main())\n"
    ),
    "hear.py": (
        "import asyncio\n"
        "from rce.ros.node import Node, run\n"
        "async def main():\n"
        "    async with Node('hearer') as node:\n"
        "        def heard(message):\n"
        "            print('heard', message.data, flush=True)\n"
        "        await node.subscribe('words', 'std_msgs/String', heard)\n"
        "        await node.spin()\n"
        "run(main())\n"
    ),
}


@pytest.fixture
def machine(folder: Path) -> Iterator[Machine]:
    machine = Machine(folder, "namespace")
    for name, text in NODES.items():
        (machine.packages / "own" / "nodes" / name).write_text(text)
    yield machine
    machine.tidy()


def own(exe: str, args: str = "", tag: str = "node") -> NodeSpec:
    return NodeSpec(tag=tag, pkg="own", exe=exe, args=args)


def group(name: str = "g", address: str = "") -> Resources:
    return Resources(network=Network.GROUP, group=name, group_ip=address)


async def reached(machine: Machine, id_: str, *targets: str) -> dict[str, Any]:
    """Let a node of the container try to connect to targets; returns what it says."""
    status = machine.status(id_)
    assert status is not None
    spec = own("reach.py", " ".join(targets), tag=f"reach{status.revision}")
    kept = machine.manager._core.containers[id_].desired
    assert kept is not None
    await machine.put(
        id_, status.revision + 1, nodes=(*kept.contents.nodes, spec), resources=kept.contents.resources
    )
    await machine.node_is(id_, spec.tag, NodeState.EXITED)
    lines = (await machine.log(id_, spec.tag)).splitlines()
    found: dict[str, Any] = json.loads(next(line for line in lines if line.startswith("{")))
    return found


async def serving(machine: Machine, id_: str, resources: Resources) -> None:
    await machine.put(id_, nodes=(own("serve.py"),), resources=resources)
    await until(lambda: machine.node(id_, "node"), what=f"{id_} (faults: {machine.faults})")
    await machine.log_holds(id_, "node", "serving")


def holders(namespace: int) -> list[str]:
    """Who keeps a network namespace alive."""
    found = []
    name = f"net:[{namespace}]"
    for process in Path("/proc").glob("[0-9]*"):
        for entry in (process / "ns" / "net", *process.glob("fd/*")):
            try:
                target = str(entry.readlink())
            except OSError:
                continue
            if target == name:
                found.append(str(entry))
    return found


def switch_of(machine: Machine, user: str = "user", name: str = "g") -> int:
    """The switch of a group, as the number of its network namespace."""
    fd = machine.manager._networks._groups[user, name].switch
    return os.fstat(fd).st_ino


async def test_a_group_is_joined_and_nobody_else(machine: Machine) -> None:
    machine_addresses = [
        entry.address
        for entries in psutil.net_if_addrs().values()
        for entry in entries
        if entry.family is socket.AF_INET
    ]
    with socket.create_server(("0.0.0.0", 0)) as server:
        bait = server.getsockname()[1]
        async with machine.engine():
            await serving(machine, "user/a", group(address="10.0.0.1"))
            await serving(machine, "user/b", group(address="10.0.0.2"))
            await serving(machine, "user/c", group("h", "10.0.0.3"))
            await serving(machine, "other/d", group(address="10.0.0.4"))
            await serving(machine, "user/e", Resources())

            found = await reached(machine, "user/b", f"10.0.0.1:{PORT}", f"a:{PORT}", f"b:{PORT}")
            assert found["found"] == dict.fromkeys((f"10.0.0.1:{PORT}", f"a:{PORT}", f"b:{PORT}"), "10.0.0.2")
            assert found["ip"] == "10.0.0.2"
            assert found["hosts"].splitlines()[1:] == ["10.0.0.1 a", "10.0.0.2 b"]
            assert sorted(found["interfaces"]) == ["eth0", "lo"]
            assert found["six"] in ([], ["lo"])

            guesses = [f"10.0.0.{number}:{PORT}" for number in range(1, 7)]
            guesses += [f"{address}:{bait}" for address in machine_addresses]
            for id_, address in (("user/c", "10.0.0.3"), ("other/d", "10.0.0.4"), ("user/e", "")):
                found = await reached(machine, id_, *guesses)
                assert {target for target, heard in found["found"].items() if heard} == (
                    {f"{address}:{PORT}"} if address else set()
                )
            found = await reached(machine, "user/a", *(f"{address}:{bait}" for address in machine_addresses))
            assert not any(found["found"].values())
            assert machine.faults == []


async def test_nodes_use_the_core_of_another_container(machine: Machine) -> None:
    async with machine.engine():
        await machine.put("user/a", nodes=(own("speak.py"),), resources=group())
        await machine.put("user/b", nodes=(own("hear.py", "__master:=http://a:11311"),), resources=group())
        await until(lambda: machine.node("user/b", "node"), what="b")
        await machine.log_holds("user/b", "node", "heard through the group")
        await machine.drop("user/b")  # before the core that its node wants to tell of its end


async def test_an_address_is_given_out_once_and_again(machine: Machine) -> None:
    async with machine.engine():
        await serving(machine, "user/a", group(address="10.0.0.1"))
        await machine.put("user/b", nodes=(own("serve.py"),), resources=group(address="10.0.0.1"))
        fault = await until(lambda: machine.of(Fault), what="a fault")
        assert fault[0].id == "user/b"
        assert "the groupIp 10.0.0.1 belongs to container a of the same group; take another" in fault[0].text
        await until(lambda: is_in(machine, "user/b", EndpointState.FAILED), what="b has failed")
        await machine.drop("user/a")
        await until(lambda: machine.node("user/b", "node"), what="b")
        await machine.log_holds("user/b", "node", "serving")


async def test_a_group_outlives_its_manager_and_leaves_nothing(machine: Machine) -> None:
    async with machine.managed():
        await serving(machine, "user/a", group(address="10.0.0.1"))
        switch = switch_of(machine)
    async with machine.engine():
        assert switch_of(machine) == switch
        await machine.put("user/a", nodes=(own("serve.py"),), resources=group(address="10.0.0.1"))
        await serving(machine, "user/b", group(address="10.0.0.2"))
        found = await reached(machine, "user/b", f"10.0.0.1:{PORT}")
        assert found["found"] == {f"10.0.0.1:{PORT}": "10.0.0.2"}
        await machine.drop("user/a")
        found = await reached(machine, "user/b", f"10.0.0.1:{PORT}")
        assert found["hosts"].splitlines()[1:] == ["10.0.0.2 b"]
        assert found["found"] == {f"10.0.0.1:{PORT}": ""}
    assert holders(switch) == []


async def test_a_killed_container_comes_back_to_its_group(machine: Machine) -> None:
    async with machine.engine():
        await serving(machine, "user/a", group(address="10.0.0.1"))
        await serving(machine, "user/b", group(address="10.0.0.2"))
        first = machine.reported("user/a").incarnation
        record = next(one for one in machine.containers if one.name == first)
        machine.note_processes()
        os.kill(json.loads((record / "record.json").read_text())["pid"], 9)
        await until(lambda: machine.reported("user/a").incarnation not in ("", first), what="a new life")
        await until(lambda: machine.node("user/a", "node"), what="its node")
        await machine.log_holds("user/a", "node", "serving")
        found = await reached(machine, "user/b", f"a:{PORT}")
        assert found["found"] == {f"a:{PORT}": "10.0.0.2"}


async def test_a_container_of_the_machines_network(machine: Machine) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.setblocking(False)
        port = server.getsockname()[1]
        async with machine.engine():
            await machine.put(
                "user/a",
                nodes=(own("reach.py", f"127.0.0.1:{port}"),),
                resources=Resources(network=Network.HOST),
            )
            await machine.node_is("user/a", "node", NodeState.EXITED)
            server.accept()[0].close()
            said = json.loads(next(line for line in (await machine.log("user/a", "node")).splitlines()))
            assert said["servers"] == Path("/etc/resolv.conf").exists()
            status = machine.status("user/a")
            assert status is not None
            assert status.state is EndpointState.RUNNING


def test_the_machines_own_network_is_no_containers() -> None:
    with pytest.raises(NetworkError, match="no network namespace of its own"):
        open_namespace(os.getpid())
