"""Volumes in real containers: folders in every runtime, file systems of their size where they work."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from support.containers import Machine, until

from rce.control.messages import RemoveVolume, VolumeLimit, VolumeRemoved
from rce.control.model import EndpointState
from rce.model import MEGABYTE, NodeSpec, Resources, Volume
from rce_container.exceptions import VolumeError
from rce_container.runtimes.namespace import NamespaceRuntime
from rce_container.volumes import images
from rce_container.volumes.places import VolumePlaces
from rce_container.volumes.store import VolumeStore

BOX, OTHER = "user/box", "user/other"
SIZE = 16 * MEGABYTE
IMAGES = pytest.mark.skipif(bool(why := images.unavailable()), reason=f"volumes cannot be images: {why}")


def resources(path: str = "/data/journal", size: int = SIZE) -> Resources:
    return Resources(volumes=(Volume(name="journal", path=path, size=size),))


def own(exe: str, args: str = "") -> NodeSpec:
    return NodeSpec(tag="node", pkg="own", exe=exe, args=args)


@pytest.fixture(
    params=[
        ("process", VolumeLimit.WATCHED),
        pytest.param(("namespace", VolumeLimit.WATCHED), marks=pytest.mark.needs("bwrap")),
        pytest.param(("namespace", VolumeLimit.IMAGE), marks=[pytest.mark.needs("bwrap"), IMAGES]),
        pytest.param(("podman", VolumeLimit.IMAGE), marks=[pytest.mark.needs("podman"), IMAGES]),
    ],
    ids=lambda param: f"{param[0]}-{param[1].value}",
)
def keeper(request: pytest.FixtureRequest, folder: Path) -> Iterator[Machine]:
    runtime, limit = request.param
    machine = Machine(folder, runtime)
    machine.volume_limit = limit
    yield machine
    machine.tidy()


@pytest.fixture
def sandbox(folder: Path) -> Iterator[Machine]:
    """A machine whose containers are isolated."""
    machine = Machine(folder, "namespace")
    yield machine
    machine.tidy()


def volume_of(machine: Machine, user: str = "user") -> list[Path]:
    place = machine.folder / "state" / "volumes" / user
    return sorted(place.iterdir()) if place.is_dir() else []


async def put(machine: Machine, exe: str, revision: int = 1, id_: str = BOX, size: int = SIZE) -> None:
    await machine.put(id_, revision, nodes=(own(exe),), resources=resources(size=size))


async def kill_environment(machine: Machine) -> None:
    """Kill the environment; the node ends with it, and the container is made again."""
    pid = await machine.node_pid(BOX, "node")
    environment = next(
        int(line.split()[1])
        for line in Path(f"/proc/{pid}/status").read_text().splitlines()
        if line.startswith("PPid:")
    )
    before = machine.reported(BOX).incarnation
    os.kill(environment, signal.SIGKILL)
    with contextlib.suppress(ProcessLookupError):  # in a sandbox it has ended with the environment
        os.kill(pid, signal.SIGKILL)
    await until(lambda: machine.reported(BOX).incarnation not in ("", before), what="another incarnation")


async def test_files_outlive_the_container(keeper: Machine) -> None:
    async with keeper.engine():
        await put(keeper, "keep.py")
        first = await keeper.log_holds(BOX, "node", "1 runs")
        if keeper.runtime.isolated:
            assert first.startswith("/data/journal ")
        await keeper.drop(BOX)
        await put(keeper, "keep.py", 200)
        await keeper.log_holds(BOX, "node", "2 runs")
    async with keeper.engine():  # another manager: all containers of the former one have ended
        await put(keeper, "keep.py", 300)
        await keeper.log_holds(BOX, "node", "3 runs")
    assert len(volume_of(keeper)) == 1


async def test_files_outlive_a_kill(keeper: Machine) -> None:
    async with keeper.engine():
        await put(keeper, "keep.py")
        await keeper.log_holds(BOX, "node", "1 runs")
        for number in (2, 3):
            await kill_environment(keeper)
            await keeper.log_holds(BOX, "node", f"{number} runs")


async def test_an_adopted_container_keeps_its_volume(keeper: Machine) -> None:
    async with keeper.managed():
        await put(keeper, "keep.py")
        await keeper.log_holds(BOX, "node", "1 runs")
    async with keeper.engine():
        await put(keeper, "keep.py")
        await put(keeper, "keep.py", id_=OTHER)
        await until(lambda: any("has not ended yet" in text for text in keeper.faults), what="a refusal")
        await keeper.drop(BOX)
        await keeper.log_holds(OTHER, "node", "2 runs")


@pytest.mark.needs("bwrap")
@IMAGES
async def test_an_image_takes_no_more_than_its_size(sandbox: Machine) -> None:
    machine = sandbox
    machine.volume_limit = VolumeLimit.IMAGE
    async with machine.engine():
        await put(machine, "fill.py")
        text = await machine.log_holds(BOX, "node", "wrote")
        assert f"stopped {errno.ENOSPC}" in text
        assert int(text.split()[-1]) < SIZE
        await until(lambda: machine.usage and machine.usage[-1].volumes.get("user/journal", 0) > SIZE // 2)
        assert machine.usage[-1].volumes["user/journal"] <= SIZE
        await machine.drop(BOX)
        await put(machine, "fill.py", 200, size=3 * SIZE)  # it grows
        await until(lambda: "wrote" in "".join(machine.faults) or machine.node(BOX, "node"), what="a start")
        text = await machine.log_holds(BOX, "node", "wrote")
        assert 2 * SIZE < int(text.split()[-1]) < 3 * SIZE
    (image,) = volume_of(machine)
    assert 3 * SIZE - MEGABYTE < image.stat().st_blocks * 512 <= 3 * SIZE + MEGABYTE
    assert not images.is_attached(image)


async def test_a_container_with_a_full_folder_is_ended(machine: Machine) -> None:
    async with machine.engine():
        await put(machine, "fill.py")
        await until(lambda: any("may hold 16 MiB" in text for text in machine.faults), what="a fault")
        await until(lambda: sum("may hold 16 MiB" in text for text in machine.faults) > 1, what="a refusal")
        assert machine.reported(BOX).state is not EndpointState.RUNNING
        await machine.drop(BOX)
        await put(machine, "fill.py", 200, size=8 * SIZE)
        await machine.log_holds(BOX, "node", "wrote")


async def test_a_volume_is_removed_when_its_container_ended(keeper: Machine) -> None:
    async with keeper.engine() as manager:
        await put(keeper, "keep.py")
        await keeper.log_holds(BOX, "node", "1 runs")
        await manager.handle(RemoveVolume(volume="user/journal"))
        assert len(volume_of(keeper)) == 1
        await keeper.drop(BOX)
        await until(lambda: keeper.of(VolumeRemoved), what="it is removed")
        assert keeper.of(VolumeRemoved) == [VolumeRemoved(volume="user/journal")]
        assert volume_of(keeper) == []
        await put(keeper, "keep.py", 200)
        await keeper.log_holds(BOX, "node", "1 runs")
        await keeper.drop(BOX, 300)
        await manager.handle(RemoveVolume(volume="user/journal"))
        await until(lambda: len(keeper.of(VolumeRemoved)) == 2, what="it is removed again")
        assert volume_of(keeper) == []


@pytest.mark.needs("bwrap")
async def test_users_do_not_see_volumes_of_others(sandbox: Machine) -> None:
    machine = sandbox
    async with machine.engine():
        await put(machine, "keep.py")
        await machine.log_holds(BOX, "node", "1 runs")
        await put(machine, "keep.py", id_="mallory/box")
        await machine.log_holds("mallory/box", "node", "1 runs")
        pid = await machine.node_pid("mallory/box", "node")
        inside = Path(f"/proc/{pid}/root")
        assert not (inside / str(machine.folder / "state").lstrip("/")).exists()
        assert [path.name for path in (inside / "data").iterdir()] == ["journal"]
        (theirs,), (ours,) = volume_of(machine, "mallory"), volume_of(machine)
        assert theirs != ours
        assert machine.folder.joinpath("state/volumes").stat().st_mode & 0o077 == 0


@pytest.mark.needs("bwrap")
async def test_a_volume_may_not_hide_the_engine(sandbox: Machine) -> None:
    machine = sandbox
    async with machine.engine():
        hidden = str(machine.packages)
        await machine.put(BOX, nodes=(own("keep.py"),), resources=resources(path=hidden))
        await until(lambda: any(f"would hide {hidden}" in text for text in machine.faults), what="a refusal")
        container = machine.manager._core.containers[BOX]
        await until(lambda: container.failures >= 3, what="it was tried three times")
        assert not any("has not ended yet" in text for text in machine.faults), "its former tries had ended"


@IMAGES
def test_a_volume_that_is_not_mounted_is_not_opened(tmp_path: Path) -> None:
    """An empty folder is in its place, which is not what the volume holds."""
    places = VolumePlaces(tmp_path / "volumes", images=True)
    image = places.image("user/journal")
    places.make_folder(image.parent)
    images.make(image, SIZE)
    place = tmp_path / "place"
    place.mkdir()
    with pytest.raises(VolumeError, match="is not mounted in its container"):
        places.open_running("user/journal", os.getpid(), str(place))


@pytest.fixture
def held_prepare(monkeypatch: pytest.MonkeyPatch) -> Iterator[HeldPrepare]:
    """Volumes are prepared when the test says so."""
    held = HeldPrepare()
    monkeypatch.setattr(VolumeStore, "prepare", held.prepare_of(VolumeStore.prepare))
    yield held
    held.may_end.set()


class HeldPrepare:
    """Delays what prepares volumes.

    Attributes:
        began: Set when it was called.
        may_end: To be set by the test.
        claimed: For each call whether the container had its volumes until the end.
    """

    def __init__(self) -> None:
        self.began, self.may_end = threading.Event(), threading.Event()
        self.claimed: list[bool] = []

    def prepare_of(self, prepare: Callable[[VolumeStore, str], None]) -> Callable[[VolumeStore, str], None]:
        def prepare_late(store: VolumeStore, incarnation_id: str) -> None:
            self.began.set()
            self.may_end.wait()
            prepare(store, incarnation_id)
            self.claimed.append(bool(store.claims(incarnation_id)))

        return prepare_late


@pytest.mark.needs("bwrap")
@IMAGES
async def test_enlarging_may_take_longer_than_a_start(sandbox: Machine, held_prepare: HeldPrepare) -> None:
    sandbox.volume_limit = VolumeLimit.IMAGE
    async with sandbox.engine(start_timeout=5.0):
        await put(sandbox, "keep.py")
        asyncio.get_running_loop().call_later(6.0, held_prepare.may_end.set)
        await sandbox.log_holds(BOX, "node", "1 runs")
        assert sandbox.faults == []
        assert held_prepare.claimed == [True]
        await sandbox.drop(BOX)


@pytest.fixture
def held_fork_server(sandbox: Machine) -> Iterator[Callable[[], None]]:
    """Environments are not made, as if a volume had very many files, until the test calls this."""
    assert isinstance(sandbox.runtime, NamespaceRuntime)
    sandbox.volume_limit = VolumeLimit.IMAGE
    fork_server = sandbox.runtime._fork_server
    fork_server.start()
    os.kill(fork_server.pid, signal.SIGSTOP)

    def go_on() -> None:
        os.kill(fork_server.pid, signal.SIGCONT)

    yield go_on
    go_on()


@pytest.mark.needs("bwrap")
@IMAGES
async def test_giving_files_may_take_longer_than_a_start(
    sandbox: Machine, held_fork_server: Callable[[], None]
) -> None:
    """Each file of a volume is given to the user of the container, within its share of a processor."""
    async with sandbox.engine(start_timeout=5.0):
        await put(sandbox, "keep.py")
        asyncio.get_running_loop().call_later(6.0, held_fork_server)
        await sandbox.log_holds(BOX, "node", "1 runs")
        assert sandbox.faults == []
        await sandbox.drop(BOX)


@pytest.mark.needs("bwrap")
@IMAGES
async def test_a_container_that_gives_files_can_be_dropped(
    sandbox: Machine, held_fork_server: Callable[[], None]
) -> None:
    async with sandbox.engine(interrupt_timeout=0.1, terminate_timeout=0.1, cleanup_timeout=0.1):
        await put(sandbox, "keep.py")
        (incarnation,) = sandbox.manager._incarnations.values()
        await until(lambda: incarnation._gives_files, what="its volume is prepared")
        await sandbox.drop(BOX)
        held_fork_server()


@pytest.mark.needs("bwrap")
@IMAGES
async def test_a_killed_container_has_its_volume_until_it_is_ready(
    sandbox: Machine, held_prepare: HeldPrepare
) -> None:
    """Another one would work on the same image, beside the thread of the first one."""
    sandbox.volume_limit = VolumeLimit.IMAGE
    async with sandbox.engine() as manager:
        await put(sandbox, "keep.py")
        await until(held_prepare.began.is_set, what="its volume is prepared")
        manager.kill_all()
        asyncio.get_running_loop().call_later(2.0, held_prepare.may_end.set)
        await until(lambda: held_prepare.claimed, what="its volume is ready")
        assert held_prepare.claimed[0]
        manager.kill_all()
        await sandbox.drop(BOX)


GROW = """
import sys, time
from pathlib import Path
from rce_container.volumes import images
images.grow(Path(sys.argv[1]), int(sys.argv[2]), time.monotonic())
"""
RESIZE = """#!/bin/sh
echo started >FIFO
read -r word <FIFO
echo "This goes to the killed manager."
exec RESIZE2FS "$@"
"""


@IMAGES
def test_a_tool_of_a_killed_manager_keeps_the_image(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It ends as if the manager lived, and no other program writes to the image meanwhile."""
    places = VolumePlaces(tmp_path / "volumes", images=True)
    image, fifo, tool = places.image("user/journal"), tmp_path / "fifo", tmp_path / "bin" / "resize2fs"
    places.make_folder(image.parent)
    images.make(image, SIZE)
    os.mkfifo(fifo)
    tool.parent.mkdir()
    tool.write_text(RESIZE.replace("FIFO", str(fifo)).replace("RESIZE2FS", str(shutil.which("resize2fs"))))
    tool.chmod(0o755)
    path = f"{tool.parent}:{os.environ['PATH']}"
    command = [sys.executable, "-c", GROW, str(image), str(2 * SIZE)]
    with subprocess.Popen(command, env={**os.environ, "PATH": path}) as manager:
        assert fifo.read_text() == "started\n"
        manager.kill()
    with pytest.raises(VolumeError, match="is still enlarging it"):
        images.grow(image, 2 * SIZE, time.monotonic())
    with pytest.raises(VolumeError, match="a program is enlarging it"):
        places.open("user/journal")
    fifo.write_text("go on\n")
    images.grow(image, 2 * SIZE, time.monotonic() + 60)
    subprocess.run(["e2fsck", "-f", "-n", image], check=True, capture_output=True)
    root = places.open("user/journal")
    assert os.fstatvfs(root).f_blocks * os.fstatvfs(root).f_frsize > SIZE
    os.close(root)
    images.wait_until_unused(image, time.monotonic() + 60)


@IMAGES
async def test_an_image_is_not_mounted_twice(tmp_path: Path) -> None:
    store = VolumeStore(tmp_path / "volumes", images=True)
    (volume,) = resources().volumes
    store.claim("user", "1" * 12, [volume])
    await asyncio.to_thread(store.prepare, "1" * 12)
    with pytest.raises(VolumeError, match="belongs to a container that has not ended"):
        store.claim("user", "2" * 12, [volume])
    with pytest.raises(VolumeError, match="is not the name of a volume"):
        store.doom("user/../../etc")
    store.release("1" * 12)
    assert store.doom("user/journal")
    store.places.delete_removed()
    assert [path.name for path in (tmp_path / "volumes" / "user").iterdir()] == []
