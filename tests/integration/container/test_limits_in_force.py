"""Limits that hold, on the machine's own cgroups; nodes here try to take more than they may."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import pytest
from support.containers import Machine, until

from rce.control.messages import Gone
from rce.control.model import EndpointState, EndpointStatus, EndpointUsage, NodeState, NodeUsage
from rce.model.specs import NodeSpec, Resources
from rce_container.environment import proc
from rce_container.folder import StateFolder
from rce_container.limits import Limits, RlimitLimiter, choose_limiter

pytestmark = pytest.mark.needs("cgroups")

MB = 1 << 20
BOX, OTHER = "user/box", "user/other"
SMALL = Resources(memory=64 * MB)
OUT_OF_MEMORY = (
    "out of memory: the container's limit of 64 MB; ask for more with `rce resize box --memory 128M`"
)

NODES = {
    "hog.py": (
        "import sys, time\n"
        "kept = []\n"
        "for count in range(int(sys.argv[1])):\n"
        "    kept.append(b'x' * 1000000)\n"
        "    if count % 10 == 0:\n        print('has', count, flush=True)\n"
        "print('has all', flush=True)\n"
        "time.sleep(600)\n"
    ),
    "spawn.py": (
        "import subprocess, sys, time\n"
        "code = 'kept = [bytes(1) + b\"x\" * 1000000 for _ in range(200)]'\n"
        "print('child ended with', subprocess.run([sys.executable, '-c', code]).returncode, flush=True)\n"
        "time.sleep(600)\n"
    ),
    "bomb.py": (
        "import os, time\n"
        "count = 0\n"
        "while True:\n"
        "    try:\n        pid = os.fork()\n"
        "    except OSError:\n        break\n"
        "    if pid == 0:\n        time.sleep(600)\n        os._exit(0)\n"
        "    count += 1\n"
        "print('made', count, flush=True)\n"
        "time.sleep(600)\n"
    ),
    "spin.py": "print('spins', flush=True)\nwhile True:\n    pass\n",
}


@pytest.fixture
def packages(machine: Machine) -> Machine:
    nodes = machine.packages / "greedy" / "nodes"
    nodes.mkdir(parents=True)
    (machine.packages / "greedy" / "package.yaml").write_text("name: greedy\n")
    for name, text in NODES.items():
        (nodes / name).write_text(text)
    return machine


def greedy(tag: str, args: str = "") -> NodeSpec:
    return NodeSpec(tag=tag, pkg="greedy", exe=f"{tag}.py", args=args)


def usage(machine: Machine, id_: str) -> EndpointUsage:
    """The newest that a machine told of a container; nothing used if it told nothing yet."""
    return machine.usage[-1].endpoints.get(id_, EndpointUsage()) if machine.usage else EndpointUsage()


def node_usage(machine: Machine, id_: str, tag: str) -> NodeUsage:
    return usage(machine, id_).nodes.get(tag, NodeUsage())


async def short_of_memory(machine: Machine) -> str:
    """Return a container with two nodes, of which one took too much memory and the kernel killed one process.

    Now and then the kernel kills a second one before it has the memory of the first one back.
    """
    for number in range(3):
        box, text = f"user/box{number}", OUT_OF_MEMORY.replace("resize box", f"resize box{number}")
        talk = NodeSpec(tag="talk", pkg="own", exe="talk.py")
        await machine.put(box, resources=SMALL, nodes=(talk, greedy("hog", "200")))
        died = await machine.node_is(box, "hog", NodeState.FAILED)
        assert died.exit_code == -signal.SIGKILL
        assert died.detail.startswith(text)
        assert any(text in fault for fault in machine.faults)
        if await until(partial(killed_in, machine, box)) == 1:
            return box
    raise AssertionError("more than one process was killed each time")


def killed_in(machine: Machine, id_: str) -> int:
    """How many processes the kernel killed in a container, as it told last."""
    return usage(machine, id_).oom_kills


async def test_who_takes_too_much_memory_dies_alone(packages: Machine) -> None:
    machine = packages
    async with machine.engine():
        await machine.put(OTHER, resources=Resources(memory=256 * MB), nodes=(greedy("hog", "100"),))
        box = await short_of_memory(machine)
        await machine.log_holds(OTHER, "hog", "has all")
        pid = await machine.node_pid(box, "talk")
        seen = usage(machine, box)
        assert (seen.oom_kills, seen.memory_limit) == (1, 64 * MB)
        assert 50 * MB < seen.memory_peak <= 64 * MB
        await until(lambda: node_usage(machine, OTHER, "hog").memory > 100_000_000)
        assert usage(machine, OTHER).oom_kills == 0
        assert Path(f"/proc/{pid}").exists()
        assert not [fault for fault in machine.faults if "a node started" in fault]


async def test_a_process_of_a_node_that_ran_out_of_memory_is_told_of(packages: Machine) -> None:
    async with packages.engine():
        await packages.put(BOX, resources=SMALL, nodes=(greedy("spawn"),))
        await packages.log_holds(BOX, "spawn", "child ended with -9")
        await until(lambda: any("a process that a node started was killed" in f for f in packages.faults))
        assert packages.reported_node(BOX, "spawn").state in (NodeState.STARTING, NodeState.RUNNING)


async def test_a_container_that_cannot_live_at_all_says_why(packages: Machine) -> None:
    async with packages.engine(slot_memory=2 * MB):
        await packages.put(BOX)
        await until(
            lambda: any("out of memory: the container's limit of 2 MB" in f for f in packages.faults),
            what=lambda: packages.faults,
        )


async def test_a_share_of_a_processor_is_not_exceeded(packages: Machine) -> None:
    async with packages.engine():
        await packages.put(BOX, resources=Resources(cpu=0.2), nodes=(greedy("spin"),))
        await packages.log_holds(BOX, "spin", "spins")
        first = await until(lambda: usage(packages, BOX))
        begin = time.monotonic()
        await until(lambda: usage(packages, BOX).cpu_s >= first.cpu_s + 0.5, timeout=50)
        last = usage(packages, BOX)
        assert (last.cpu_s - first.cpu_s) / (time.monotonic() - begin) < 0.4
        assert last.throttled_s > first.throttled_s
        assert last.cpu_limit == pytest.approx(0.2)


async def test_a_fork_bomb_stops_at_the_limit(packages: Machine) -> None:
    machine = packages
    async with machine.engine(slot_processes=40):
        await machine.put(OTHER, nodes=(NodeSpec(tag="talk", pkg="own", exe="talk.py"),))
        await machine.put(BOX, nodes=(greedy("bomb"),))
        await machine.log_holds(BOX, "bomb", "made")
        text = await machine.log_holds(BOX, "bomb", "\n")
        assert 0 < int(text.split("made")[1].split()[0]) < 40
        text = "its limit of 40 processes and threads is reached"
        await until(lambda: any(text in fault for fault in machine.faults))
        await until(lambda: node_usage(machine, BOX, "bomb").processes > 10)
        assert usage(machine, BOX).processes <= 40
        await machine.put(OTHER, 2, nodes=(NodeSpec(tag="more", pkg="own", exe="talk.py"),))
        await machine.log_holds(OTHER, "more", "hello")
        await machine.drop(BOX)


def with_a_running_node(machine: Machine) -> EndpointStatus | None:
    """The container's status, if it tells its node's process: what a node prints may come before that."""
    status = machine.status(BOX)
    return status if status and any(node.pid for node in status.nodes) else None


async def test_limits_change_while_it_runs(packages: Machine) -> None:
    machine = packages
    async with machine.engine():
        nodes = (greedy("hog", "100"),)
        await machine.put(BOX, 1, resources=Resources(memory=400 * MB), nodes=nodes)
        await machine.log_holds(BOX, "hog", "has all")
        before = await until(lambda: with_a_running_node(machine))
        await machine.put(BOX, 2, resources=Resources(memory=200 * MB, cpu=0.5), nodes=nodes)
        await until(lambda: usage(machine, BOX).memory_limit == 200 * MB)
        assert usage(machine, BOX).cpu_limit == pytest.approx(0.5)
        await machine.put(BOX, 3, resources=Resources(memory=64 * MB, cpu=0.25), nodes=nodes)
        fault = await until(lambda: next((f for f in machine.faults if "cannot be limited" in f), None))
        assert fault.startswith("container box: its memory cannot be limited to 64 MB: it needs ")
        assert "stop some of its nodes first" in fault
        assert "the limits stay as they were" in fault
        count = len(machine.usage)
        await until(lambda: len(machine.usage) > count + 1)
        assert usage(machine, BOX).memory_limit == 200 * MB
        assert usage(machine, BOX).cpu_limit == pytest.approx(0.5)
        after = machine.reported(BOX)
        assert (after.incarnation, after.nodes[0].pid) == (before.incarnation, before.nodes[0].pid)
        assert after.state in (EndpointState.RUNNING, EndpointState.DEGRADED)


async def test_no_cgroup_is_left_by_a_container_that_ended(packages: Machine) -> None:
    machine = packages
    async with machine.engine():
        await machine.put(BOX, nodes=(NodeSpec(tag="talk", pkg="own", exe="talk.py"),))
        await machine.log_holds(BOX, "talk", "hello")
        assert machine.control_groups()
        await machine.drop(BOX)
        assert not machine.control_groups()
        assert machine.of(Gone)
    assert not machine.cell_parents()


async def test_next_manager_removes_cgroups_of_the_killed(packages: Machine) -> None:
    """The next manager removes the cgroups of all that was killed."""
    machine = packages
    async with machine.managed():
        await machine.put(BOX, nodes=(NodeSpec(tag="talk", pkg="own", exe="talk.py"),))
        await machine.log_holds(BOX, "talk", "hello")
    for process in machine.processes():
        proc.kill(process)
    assert machine.control_groups()
    async with machine.engine():
        await until(lambda: not machine.control_groups(), what=machine.control_groups)


async def test_the_next_manager_keeps_the_limits_of_what_it_adopts(packages: Machine) -> None:
    machine = packages
    async with machine.managed():
        await machine.put(BOX, resources=SMALL, nodes=(greedy("hog", "10"),))
        await machine.log_holds(BOX, "hog", "has all")
        control_groups = machine.control_groups()
    async with machine.engine():
        assert machine.control_groups() == control_groups
        await until(lambda: machine.usage and BOX in machine.usage[-1].endpoints)
        seen = usage(machine, BOX)
        assert seen.memory_limit == 64 * MB
        nodes = (greedy("hog", "200"),)
        await machine.put(BOX, 2, resources=SMALL, nodes=nodes)
        died = await machine.node_is(BOX, "hog", NodeState.FAILED)
        assert died.detail.startswith("out of memory")


async def test_orphaned_cgroups_are_swept_with_processes(folder: Path) -> None:
    """Cells of which nothing else is left are swept with their processes."""
    with StateFolder(folder / "state", folder / "run") as state:
        limiter = choose_limiter(state.token, state.cgroups)
        limiter.sweep(())
        control_group = limiter.create("0123456789ab", Limits(memory=64 * MB))
        script = 'for file; do echo $$ >"$file"; done; exec sleep 600'
        lost = subprocess.Popen(["/bin/sh", "-c", script, "sh", *control_group.join])
        await until(control_group.pids)
        machine = Machine(folder, "process")
    async with machine.engine():
        assert lost.wait() == -signal.SIGKILL
        assert not machine.control_groups()


async def test_memory_kills_nodes_before_environment_and_engine(packages: Machine) -> None:
    """Nodes die before their environment and both before the engine."""
    machine = packages
    async with machine.engine():
        await machine.put(BOX, nodes=(NodeSpec(tag="talk", pkg="own", exe="talk.py"),))
        await machine.log_holds(BOX, "talk", "hello")
        node = await machine.node_pid(BOX, "talk")
        environment = machine.environment().pid
        scores = [int(Path(f"/proc/{pid}/oom_score_adj").read_text()) for pid in (node, environment)]
        assert scores == [600, 300]


async def test_without_cgroups_each_process_is_limited(
    packages: Machine, monkeypatch: pytest.MonkeyPatch
) -> None:
    machine = packages
    monkeypatch.setattr("support.containers.choose_limiter", lambda *_: RlimitLimiter())
    async with machine.engine():
        await machine.put(BOX, resources=Resources(memory=128 * MB), nodes=(greedy("hog", "300"),))
        died = await machine.node_is(BOX, "hog", NodeState.FAILED)
        # From Python 3.13 on there may be no memory left for the traceback.
        assert "MemoryError" in died.detail or "lost sys.stderr" in died.detail
        assert "has 60" in await machine.log(BOX, "hog")
        await until(lambda: machine.usage and BOX in machine.usage[-1].endpoints)
        seen = usage(machine, BOX)
        assert (seen.memory_limit, seen.memory_peak) == (0, 0)
        assert seen.memory > MB
        await machine.put(BOX, 2, resources=Resources(memory=256 * MB))
        await until(lambda: any("destroy it and create it again" in fault for fault in machine.faults))


@pytest.mark.needs("root")
def test_a_user_to_whom_no_cgroup_belongs_gets_the_weaker_limits() -> None:
    code = (
        "import logging, os, pathlib\n"
        "from rce_container.limits import choose_limiter\n"
        "logging.disable()\n"
        "os.setresuid(65534, 65534, 65534)\n"
        "limiter = choose_limiter('t', pathlib.Path('/nonexistent'))\n"
        "print(limiter.name, limiter.detail)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stdout.startswith("rlimit limits of containers are weak: no cgroup can be used"), done.stderr
    assert "Permission denied" in done.stdout
