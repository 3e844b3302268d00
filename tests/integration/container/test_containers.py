"""Containers with real processes, in every runtime that works here."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import socket
from functools import partial
from pathlib import Path

import pytest
from support.container_peers import Peer, joined
from support.container_specs import ECHO, ECHO_INTERFACES, MACHINE
from support.containers import Machine, is_in, until

from rce.control.messages import Status
from rce.control.model import EndpointState, LinkAddress, NodeState
from rce.model.specs import InterfaceSpec, NodeSpec, ParameterSpec
from rce.ros.types import TypeRegistry
from rce_container.environment import proc
from rce_container.forkserver.mounts import HOME

BOX = "user/box"
STRING = TypeRegistry().message("std_msgs/String")


def own(exe: str, args: str = "", tag: str = "node") -> NodeSpec:
    return NodeSpec(tag=tag, pkg="own", exe=exe, args=args)


async def start_echo(machine: Machine) -> LinkAddress:
    await machine.put(BOX, nodes=(ECHO,), interfaces=ECHO_INTERFACES, peer="user/robot")
    status = await until(lambda: machine.status(BOX), what="a status")
    return status.address


async def echo(peer: Peer, text: str) -> None:
    payload = STRING.serialize(STRING.new(data=text))
    peer.ends["req"].port.send(payload)
    async with asyncio.timeout(60):
        assert await peer.ends["resp"].received.get() == payload
        assert await peer.ends["srv"].port.call(payload) == payload


@pytest.mark.parametrize("way", ["unix", "tcp"])
async def test_a_peer_talks_to_a_node(machine: Machine, way: str) -> None:
    async with machine.engine():
        address = await start_echo(machine)
        async with joined(address, MACHINE if way == "unix" else "another") as peer:
            await peer.active()
            for number in range(20):
                await echo(peer, f"number {number}")
            await until(lambda: machine.reported(BOX).interfaces == {"req": True, "resp": True, "srv": True})
            assert machine.reported(BOX).connections == (1, 2, 3)

            def counted() -> bool:
                if not machine.usage:
                    return False
                counters = machine.usage[-1].endpoints[BOX].interfaces.get("req")
                return counters is not None and counters.messages_in == 20

            await until(counted, what="the counters")
            usage = machine.usage[-1].endpoints[BOX]
            assert usage.memory > 5_000_000
            assert usage.cpu_s > 0
            assert usage.processes >= 3
            payload = usage.interfaces["req"].bytes_in
            assert usage.link_in > payload > 0, "headers count too"
        await until(lambda: not any(machine.reported(BOX).interfaces.values()), what="inactive interfaces")
        assert machine.faults == []
        await machine.drop(BOX)
        machine.check_clean()


async def test_a_killed_environment_is_noticed_and_made_again(machine: Machine) -> None:
    async with machine.engine():
        address = await start_echo(machine)
        async with joined(address) as peer:
            await peer.active()
            first = machine.reported(BOX)
            machine.note_processes()
            os.kill(machine.environment().pid, signal.SIGKILL)
            await until(lambda: machine.reported(BOX).incarnation != first.incarnation)
            await until(lambda: False in peer.ends["req"].history, what="its peer notices")
            await until(lambda: machine.reported(BOX).state is EndpointState.RUNNING)
            assert all(not proc.alive(pid, start) for pid, start in machine.pids.items())
            await peer.wire(machine.reported(BOX).address, ECHO_INTERFACES, 2)
            await peer.active()
            await echo(peer, "again")
            history = peer.ends["req"].history
            assert history == [number % 2 == 0 for number in range(len(history))], "it changes each time"
            assert history[-1]
        assert any("ended unexpectedly" in text for text in machine.faults)


async def test_every_outer_process_may_be_killed(machine: Machine) -> None:
    async with machine.engine():
        await machine.put(BOX, nodes=(own("talk.py"),))
        for _ in range(2):
            await machine.node_is(BOX, "node", NodeState.STARTING)
            incarnation = machine.reported(BOX).incarnation
            machine.note_processes()
            old = dict(machine.pids)
            os.kill(machine.shims()[0].pid, signal.SIGKILL)
            await until(lambda: machine.reported(BOX).incarnation not in ("", incarnation))  # noqa: B023
            assert not [pid for pid, start in old.items() if proc.alive(pid, start)]


async def test_a_node_that_dies_is_told_and_not_restarted(machine: Machine) -> None:
    async with machine.engine():
        await machine.put(BOX, nodes=(ECHO, own("fail.py"), own("end.py", tag="end")))
        node = await machine.node_is(BOX, "node", NodeState.FAILED)
        assert (node.exit_code, node.pid) == (3, 0)
        assert node.detail == "exit code 3; its last output: it is broken"
        await machine.node_is(BOX, "end", NodeState.EXITED)
        running = await machine.node_is(BOX, "echo", NodeState.RUNNING)
        assert "stringEcho" in Path(f"/proc/{running.pid}/cmdline").read_text()
        os.kill(running.pid, signal.SIGKILL)
        assert (await machine.node_is(BOX, "echo", NodeState.FAILED)).exit_code == -signal.SIGKILL
        assert any(
            text.endswith("node node failed: exit code 3; its last output: it is broken")
            for text in machine.faults
        )
        assert any("node echo failed: killed by SIGKILL" in text for text in machine.faults)
        await machine.put(BOX, 2, nodes=(own("talk.py", "anew"),))
        assert "hello anew" in await machine.log_holds(BOX, "node", "anew")


async def test_invalid_request_is_reported_and_spoils_nothing_else(machine: Machine) -> None:
    async with machine.engine():
        await machine.put(
            BOX,
            nodes=(
                NodeSpec(tag="a", pkg="nowhere", exe="x.py"),
                NodeSpec(tag="b", pkg="own", exe="missing.py"),
                own("talk.py"),
            ),
            interfaces=(
                InterfaceSpec(tag="bad", type="PublisherInterface", message_type="none/Such", addr="x"),
                InterfaceSpec(tag="conv", type="PublisherConverter", message_type="std_msgs/String"),
                InterfaceSpec(
                    tag="good", type="PublisherInterface", message_type="std_msgs/String", addr="y"
                ),
            ),
            parameters=(ParameterSpec(name="p", value="$(find nowhere)"),),
        )
        await machine.log_holds(BOX, "node", "hello")
        await until(lambda: len(machine.faults) >= 5, what=f"faults: {machine.faults}")
        text = "\n".join(machine.faults)
        for part in (
            "node a cannot be started: no package 'nowhere'",
            "node b cannot be started: package own has no executable 'missing.py'",
            "parameter p",
            "none/Such",
            "a container has no PublisherConverter",
        ):
            assert part in text
        await until(lambda: "good" in machine.reported(BOX).interfaces)
        assert machine.reported(BOX).revision == 1


async def test_parameters_arguments_and_environment(machine: Machine) -> None:
    check = NodeSpec(
        tag="node", pkg="own", exe="talk.py", args="'a b' $(find own)", name="talker", namespace="Robot1"
    )
    async with machine.engine():
        await machine.put(BOX, nodes=(check,))
        found = await machine.log_holds(BOX, "node", "Robot1\n")
        assert found.split("\n")[0] == f"hello a b {machine.packages}/own __name:=talker __ns:=/Robot1"


async def test_a_stubborn_node_is_killed(machine: Machine) -> None:
    async with machine.engine(interrupt_timeout=0.2, terminate_timeout=0.2):
        await machine.put(BOX, nodes=(own("stubborn.py"),))
        await machine.log_holds(BOX, "node", "ready")
        await machine.put(BOX, 2)
        await until(lambda: not machine.reported(BOX).nodes)
        assert "no " in await machine.log(BOX, "node")
        assert machine.faults == []


async def test_what_a_node_left_behind_dies_with_it(machine: Machine) -> None:
    async with machine.engine(interrupt_timeout=0.5):
        await machine.put(BOX, nodes=(own("daemon.py"), own("talk.py", tag="other")))
        await machine.log_holds(BOX, "node", "daemon")
        await machine.log_holds(BOX, "other", "hello")
        before = {one.pid for one in machine.processes()}
        await machine.put(BOX, 2, nodes=(own("talk.py", tag="other"),))
        await until(lambda: not [n for n in machine.reported(BOX).nodes if n.tag == "node"])
        left = {one.pid for one in machine.processes()}
        assert len(before) - len(left) == 2
        assert machine.reported_node(BOX, "other").pid in left


async def test_a_flood_of_output_is_bounded(machine: Machine) -> None:
    async with machine.engine():
        await machine.put(BOX, nodes=(own("flood.py"), own("talk.py", tag="other")))
        await machine.log_holds(BOX, "other", "hello")
        (logs,) = (path for path in (machine.folder / "state/logs/user/box").iterdir() if path.is_dir())
        await until(lambda: not list(logs.glob("node.000000000000.log")), what="the first segment is dropped")
        assert sum(path.stat().st_size for path in logs.glob("node.*")) < 3 << 20
        assert set(await machine.log(BOX, "node", -1000)) == {"x", "\n"}


async def test_a_new_manager_adopts_its_containers(machine: Machine) -> None:
    async with machine.managed():
        address = await start_echo(machine)
        async with joined(address) as peer:
            await peer.active()
            before = machine.reported(BOX)
            node = await machine.node_is(BOX, "echo", NodeState.RUNNING)
    async with machine.engine() as manager:
        assert [status.incarnation for status in manager.hello().endpoints] == [before.incarnation]
        assert manager.hello().endpoints[0].revision == 1
        assert machine.reported_node(BOX, "echo").pid == node.pid
        await machine.put(BOX, 2, nodes=(ECHO,), interfaces=ECHO_INTERFACES, peer="user/robot")
        async with joined(machine.reported(BOX).address, "another") as peer:
            await peer.active()
            await echo(peer, "by tcp through the new manager")
        assert machine.reported(BOX).incarnation == before.incarnation
        assert machine.reported_node(BOX, "echo").pid == node.pid


async def test_without_a_manager_a_container_ends_itself(machine: Machine) -> None:
    async with machine.managed(grace=1.0):
        await machine.put(BOX, nodes=(ECHO, own("daemon.py"), own("stubborn.py", tag="stubborn")))
        await machine.node_is(BOX, "echo", NodeState.RUNNING)
        await machine.log_holds(BOX, "node", "daemon")
        machine.note_processes()
    assert machine.shims()
    await until(lambda: not machine.left(), timeout=40, what=machine.left)


async def test_environment_dying_unmanaged_leaves_nothing(machine: Machine) -> None:
    """An environment that dies without a manager leaves nothing."""
    async with machine.managed(grace=1.0):
        await machine.put(BOX, nodes=(own("daemon.py"),))
        await machine.log_holds(BOX, "node", "daemon")
        machine.note_processes()
    os.kill(machine.environment().pid, signal.SIGKILL)
    await until(lambda: not machine.left(), what=machine.left)


async def test_a_manager_removes_what_the_dead_left(machine: Machine) -> None:
    async with machine.managed():
        await machine.put(BOX, nodes=(own("daemon.py"),))
        await machine.log_holds(BOX, "node", "daemon")
        machine.note_processes()
    for process in (*machine.shims(), machine.environment()):
        proc.kill(process)
    assert machine.containers
    async with machine.engine() as manager:
        assert manager.hello().endpoints == ()
        await until(lambda: not machine.left(), what=machine.left)


@pytest.mark.needs("bwrap")
async def test_a_namespace_hides_the_machine(machine: Machine, monkeypatch: pytest.MonkeyPatch) -> None:
    if not machine.runtime.isolated:
        return
    monkeypatch.setenv("RCE_SECRET", "the secret of the engine")
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        async with machine.engine():
            look = own("look.py", f"127.0.0.1 {port} {machine.folder}/state")
            await machine.put("user/box", nodes=(look, own("talk.py", tag="other")))
            seen = json.loads((await machine.log_holds(BOX, "node", "}\n")).splitlines()[0])
    assert not [name for name in seen["env"] if name.startswith(("RCE_SECRET", "XDG", "PYTEST"))]
    assert seen["env"]["HOME"] == HOME
    assert seen["host"] == "box"
    assert len(seen["pids"]) <= 7  # two nodes, what is beside them, and who is between them at a start
    assert (seen["home"], seen["tmp"]) == (True, True)
    assert (seen["usr"], seen["slash"], seen["package"]) == (False, False, False)
    assert (seen["loopback"], seen["secret"], seen["environment"]) == (False, False, False)
    assert (int(seen["caps"], 16), seen["nnp"], seen["uid"]) == (0, "1", 1000)


async def test_containers_talk_to_each_other(machine: Machine) -> None:
    """One dials the other, which a container without a network can do through its manager only."""
    request = InterfaceSpec(
        tag="srv", type="ServiceProviderInterface", message_type="Test/StringEcho", addr="far"
    )
    answer = InterfaceSpec(
        tag="srv", type="ServiceClientInterface", message_type="Test/StringEcho", addr="stringEchoService"
    )
    async with machine.engine():
        await machine.put("user/far", nodes=(ECHO,), interfaces=(answer,), peer="user/box")
        address = machine.reported("user/far").address
        await machine.put(BOX, interfaces=(request,), peer="user/far", dial=address)
        await until(lambda: machine.reported(BOX).interfaces == {"srv": True}, what="connected")


async def test_only_so_many_containers_start_at_a_time(machine: Machine) -> None:
    async with machine.engine(starts_at_once=1):
        boxes = [f"user/box{number}" for number in range(3)]
        for box in boxes:
            await machine.put(box)
        await until(machine.shims, what="a shim that has become one")
        assert len(machine.shims()) == 1
        await machine.drop(boxes[1])
        for box in (boxes[0], boxes[2]):
            await until(partial(is_in, machine, box, EndpointState.RUNNING), what=f"{box} is running")
        assert len(machine.shims()) == 2, "a container was made that was dropped before its turn came"
        assert machine.faults == []


async def test_users_take_turns_at_starts(machine: Machine) -> None:
    async with machine.engine(starts_at_once=1):
        boxes = ["user/box0", "user/box1", "user/box2", "other/box"]
        for box in boxes:
            await machine.put(box)
        for box in boxes:
            await until(partial(is_in, machine, box, EndpointState.RUNNING), what=f"{box} is running")
        told = [message.status for message in machine.of(Status)]
        order = list(dict.fromkeys(status.id for status in told if status.incarnation))
        assert order == ["user/box0", "other/box", "user/box1", "user/box2"]


async def test_a_manager_that_quits_starts_nothing_any_more(machine: Machine) -> None:
    async with machine.engine(starts_at_once=1):
        for number in range(3):
            await machine.put(f"user/box{number}")
    assert len(machine.marks) == 1
