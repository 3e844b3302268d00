"""Containers made by podman from an image or a folder, with real processes."""

from __future__ import annotations

import asyncio
import json
import os
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from support.container_peers import joined
from support.container_specs import ECHO, ECHO_INTERFACES
from support.containers import Machine, is_in, program_of, until
from support.rootfs import image_of, make_rootfs

from rce.control.messages import Fault
from rce.control.model import EndpointState, NodeState
from rce.model.specs import Network, NodeSpec, Resources
from rce.ros.types import TypeRegistry
from rce_container.environment import proc
from rce_container.runtimes.podman import PodmanRuntime

pytestmark = pytest.mark.needs("podman")

BOX = "user/box"
GONE_AFTER_S = 60.0
STRING = TypeRegistry().message("std_msgs/String")
SURROUNDINGS = """
import json, os, subprocess, sys
def can(path):
    try:
        open(path, "w").close()
    except OSError:
        return False
    return True
run = subprocess.run(["/bin/cat", "/etc/rootfs-release"], capture_output=True, text=True)
status = dict(line.split(":", 1) for line in open("/proc/self/status"))
print(json.dumps({
    "root": sorted(os.listdir("/")), "release": run.stdout, "machine": os.path.exists("/usr/sbin"),
    "uid": os.getuid(), "host": os.uname().nodename, "env": sorted(os.environ),
    "written": [path for path in ("/x", "/etc/x", "x", "/tmp/x", "/dev/shm/x") if can(path)],
    "caps": status["CapBnd"].strip(), "filter": status["Seccomp"].strip(), "python": sys.executable,
    "pids": sorted(int(name) for name in os.listdir("/proc") if name.isdigit()),
    "space": os.statvfs("/tmp").f_blocks * os.statvfs("/tmp").f_frsize,
}), flush=True)
"""


@pytest.fixture(scope="module")
def rootfs() -> Iterator[Path]:
    """A root file system without Python."""
    folder = Path(tempfile.mkdtemp(prefix="rce-rootfs-", dir="/tmp"))
    make_rootfs(folder / "root")
    yield folder / "root"
    shutil.rmtree(folder)


@pytest.fixture(scope="module")
def image(rootfs: Path) -> Iterator[str]:
    """The same as an image in podman's store."""
    with image_of(rootfs) as name:
        yield name


@pytest.fixture
def machine(folder: Path, rootfs: Path) -> Iterator[Machine]:
    """A machine where podman makes containers that ask for no image, too."""
    machine = Machine(folder, "podman", images=[str(rootfs)])
    (machine.packages / "own" / "nodes" / "surroundings.py").write_text(SURROUNDINGS)
    before = traces()
    yield machine
    machine.tidy()
    vanish(before)


@pytest.fixture
def mixed(folder: Path) -> Iterator[Machine]:
    """A machine where podman makes the containers that ask for an image, and no others."""
    machine = Machine(folder, "namespace")
    machine.runtimes["podman"].probe()
    (machine.packages / "own" / "nodes" / "surroundings.py").write_text(SURROUNDINGS)
    before = traces()
    yield machine
    machine.tidy()
    vanish(before)


def vanish(before: set[str]) -> None:
    """Wait until podman keeps no more than before; others may use it at the same time."""
    deadline = time.monotonic() + GONE_AFTER_S
    while left := traces() - before:
        assert time.monotonic() < deadline, left
        time.sleep(0.1)


def traces() -> set[str]:
    """What podman keeps of containers, and what is mounted but its store, which it mounts when it looks.

    Network namespaces count if podman named them: other tests make their own meanwhile.
    """
    listing = ["podman", "ps", "--all", "--external", "--format", "{{.Names}}"]
    found = subprocess.run(listing, capture_output=True, text=True, check=True).stdout.split()
    mounts = Path("/proc/mounts").read_text().splitlines()
    others = ("/containers/storage/overlay", "/run/netns")
    found += [line for line in mounts if not line.split()[1].endswith(others) and "/netns/rc" not in line]
    for names in ("crun/*", "containers/storage/overlay-containers/*", "netns/netns-*"):
        found += map(str, Path("/run").glob(names))
    return set(found)


def own(exe: str, tag: str = "node") -> NodeSpec:
    return NodeSpec(tag=tag, pkg="own", exe=exe)


async def surroundings(machine: Machine, id_: str) -> dict[str, Any]:
    await machine.node_is(id_, "node", NodeState.EXITED)
    lines = (await machine.log(id_, "node")).splitlines()
    found: dict[str, Any] = json.loads(next(line for line in lines if line.startswith("{")))
    return found


async def test_a_peer_talks_to_a_node_in_a_folder(machine: Machine) -> None:
    async with machine.engine():
        await machine.put(BOX, nodes=(ECHO,), interfaces=ECHO_INTERFACES, peer="user/robot")
        status = await until(lambda: machine.status(BOX), what="a status")
        async with joined(status.address) as peer:
            await peer.active()
            payload = STRING.serialize(STRING.new(data="through podman"))
            peer.ends["req"].port.send(payload)
            async with asyncio.timeout(60):
                assert await peer.ends["resp"].received.get() == payload
                assert await peer.ends["srv"].port.call(payload) == payload
        assert machine.faults == []
        await machine.drop(BOX)
        machine.check_clean()


async def test_a_container_is_confined_as_elsewhere_but_sees_the_image(machine: Machine) -> None:
    async with machine.engine():
        await machine.put(BOX, nodes=(own("surroundings.py"),))
        found = await surroundings(machine, BOX)
        assert found["release"] == "made by a test\n"
        assert not found["machine"]
        assert found["uid"] == 1000
        assert found["host"] == "box"
        assert found["written"] == ["x", "/tmp/x", "/dev/shm/x"]
        assert int(found["caps"], 16) == 0
        assert found["filter"] == "2"
        assert found["pids"][0] == 1
        assert len(found["pids"]) <= 5
        assert found["space"] <= 256 << 20
        assert not {"SUDO_USER", "SSH_CONNECTION", "PWD", "container"} & set(found["env"])


async def test_an_image_is_run_by_podman_whatever_the_default(mixed: Machine, image: str) -> None:
    async with mixed.engine():
        await mixed.put(BOX, nodes=(own("surroundings.py"),), resources=Resources(image=image))
        await mixed.put("user/plain", nodes=(own("surroundings.py"),))
        assert (await surroundings(mixed, BOX))["release"] == "made by a test\n"
        assert (await surroundings(mixed, "user/plain"))["machine"]


NOT_NAMES = ("--privileged", "dir:/", "oci:x", "../x")


async def test_an_image_that_cannot_be_had_is_told(machine: Machine, folder: Path) -> None:
    (folder / "empty").mkdir()
    assert isinstance(machine.runtime, PodmanRuntime)
    machine.runtime._images += (str(folder / "empty"),)
    reasons = dict.fromkeys(NOT_NAMES, "neither the name of an image nor the path of a folder")
    reasons |= {image: f"the folder {image} is not offered to containers" for image in ("/", "/root")}
    missing = (
        "cannot start the image localhost/rce-none:1 (if it is not there, the machine's operator can fetch it"
    )
    reasons |= {"localhost/rce-none:1": missing, str(folder / "empty"): "/bin/sh"}
    async with machine.engine():
        for number, image in enumerate(reasons):
            await machine.put(f"user/box{number}", nodes=(own("talk.py"),), resources=Resources(image=image))

        def faults() -> dict[str, str]:
            return {fault.id: fault.text for fault in reversed(machine.of(Fault))}

        await until(lambda: len(faults()) == len(reasons), what="a fault of each")
        for number, reason in enumerate(reasons.values()):
            assert reason in faults()[f"user/box{number}"]
            box = f"user/box{number}"
            await until(partial(is_in, machine, box, EndpointState.FAILED), what=f"{box} failed")


async def test_a_program_has_the_images_own_python(folder: Path) -> None:
    make_rootfs(folder / "root", python=True)
    folder.chmod(0o755)
    machine = Machine(folder, "podman", images=[str(folder / "root")])
    script = machine.packages / "own" / "nodes" / "script"
    script.write_text("#!/usr/bin/python3\nimport ssl, sys\nprint('runs in', sys.prefix, flush=True)\n")
    script.chmod(0o755)
    try:
        async with machine.engine():
            await machine.put(BOX, nodes=(own("script"),))
            await machine.node_is(BOX, "node", NodeState.EXITED)
            assert "runs in /usr" in await machine.log(BOX, "node")
    finally:
        machine.tidy()


@pytest.mark.parametrize("victim", ["unshare", "podman", "conmon", "sh", "rce-environment"])
async def test_nothing_is_left_after_any_kill(machine: Machine, victim: str) -> None:
    async with machine.engine(cleanup_timeout=2.0):
        await machine.put(BOX, nodes=(own("talk.py"),))
        await until(lambda: (node := machine.node(BOX, "node")) is not None and node.pid, what="a node")
        first = machine.reported(BOX).incarnation
        machine.note_processes()
        old = dict(machine.pids)
        shims = {one.pid for one in machine.shims()}
        victims = [
            one for one in machine.processes() if one.pid not in shims and program_of(one.pid) == victim
        ]
        assert victims, [program_of(one.pid) for one in machine.processes()]
        os.kill(victims[-1].pid, signal.SIGKILL)
        if victim == "conmon":  # only carries the end of the container to podman: the container lives on
            await machine.drop(BOX)
        else:
            await until(lambda: machine.reported(BOX).incarnation not in ("", first), what="a new life")
        assert not [pid for pid, start in old.items() if proc.alive(pid, start)]


async def test_a_container_is_adopted_and_ends_by_itself(machine: Machine) -> None:
    async with machine.managed():
        await machine.put(BOX, nodes=(own("talk.py"),))
        await machine.log_holds(BOX, "node", "hello")
        first = machine.reported(BOX).incarnation
    async with machine.managed(grace=0.3):
        assert machine.reported(BOX).incarnation == first
        await machine.put("user/brief", nodes=(own("talk.py"),))
        await machine.log_holds("user/brief", "node", "hello")
        await machine.drop(BOX)
    await until(lambda: not machine.left(), what=machine.left)


async def test_an_image_joins_the_group_of_others(mixed: Machine, image: str) -> None:
    nodes = mixed.packages / "own" / "nodes"
    (nodes / "serve.py").write_text(
        "import socket\n"
        "with socket.create_server(('', 5000)) as server:\n"
        "    print('serving', flush=True)\n"
        "    server.accept()[0].sendall(b'from the image')\n"
    )
    (nodes / "ask.py").write_text(
        "import socket\nprint(socket.create_connection(('10.0.0.1', 5000), 5).recv(100).decode())\n"
    )
    group = Resources(network=Network.GROUP, group="g", group_ip="10.0.0.1", image=image)
    async with mixed.engine():
        await mixed.put("user/a", nodes=(own("serve.py"),), resources=group)
        await until(lambda: mixed.node("user/a", "node"), what=lambda: mixed.faults)
        await mixed.log_holds("user/a", "node", "serving")
        plain = Resources(network=Network.GROUP, group="g", group_ip="10.0.0.2")
        await mixed.put("user/b", nodes=(own("ask.py"),), resources=plain)
        await mixed.node_is("user/b", "node", NodeState.EXITED)
        assert "from the image" in await mixed.log("user/b", "node")
