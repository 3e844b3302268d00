"""Volumes as the fork server's children mount them: once, and with little memory."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import time
import tracemalloc
from collections.abc import Iterator
from pathlib import Path

import pytest

from rce.model import MEGABYTE
from rce_container.environment.messages import Boot
from rce_container.exceptions import StartError
from rce_container.forkserver import volumes
from rce_container.forkserver.messages import Descriptors, SpawnRequest, VolumeOrder
from rce_container.forkserver.process import ForkServer
from rce_container.runtimes.base import clean_environ
from rce_container.volumes import images

ROOT = pytest.mark.skipif(os.geteuid() != 0, reason="only root gives files to others")
IMAGES = pytest.mark.skipif(bool(why := images.unavailable()), reason=f"volumes cannot be images: {why}")
OWNER = 54321


@pytest.fixture
def fork_server() -> Iterator[ForkServer]:
    server = ForkServer(b"", clean_environ("/"))
    yield server
    server.close()


async def count_of_attempts(server: ForkServer, folder: Path, *orders: VolumeOrder) -> int:
    """Kill each child before it answers; return how many there were."""
    first, second = folder / "first", folder / "second"
    for fifo in (first, second):
        os.mkfifo(fifo)
    boot = Boot(id="u/c", mark="1" * 12, machine="", home="", logs="", ros_port=0, isolated=True, grace=0)
    request = SpawnRequest(
        boot=boot,
        environ={},
        uid=0,
        home_bytes=0,
        tmp_bytes=0,
        join=(str(first), str(second)),  # it waits at the second one
        volumes=orders,
    )
    with contextlib.ExitStack() as stack:
        fds = [os.open(os.devnull, os.O_RDWR) for _ in range(5)]
        for fd in fds:
            stack.callback(os.close, fd)
        holder = os.pidfd_open(os.getpid())
        stack.callback(os.close, holder)
        spawn = asyncio.create_task(server.spawn(request, Descriptors(holder, *fds)))
        count = 0
        while True:
            read = asyncio.create_task(asyncio.to_thread(first.read_text))
            await asyncio.wait((read, spawn), return_when=asyncio.FIRST_COMPLETED)
            if not read.done():
                first.write_text("")  # ends the thread
                await read
                break
            os.kill(int(read.result()), signal.SIGKILL)
            count += 1
    with pytest.raises(StartError, match=r"died as it was made|ends each time"):
        await spawn
    return count


async def test_an_environment_that_dies_is_made_again(fork_server: ForkServer, tmp_path: Path) -> None:
    assert await count_of_attempts(fork_server, tmp_path, VolumeOrder(path="/data")) == 3


async def test_one_with_an_image_is_not_made_again(fork_server: ForkServer, tmp_path: Path) -> None:
    """The image may still be mounted in the namespaces, where a next one would mount it again."""
    order = VolumeOrder(path="/data", image=str(tmp_path / "volume.img"))
    assert await count_of_attempts(fork_server, tmp_path, order) == 1


@IMAGES
def test_an_image_is_attached_once(tmp_path: Path) -> None:
    image = tmp_path / "volume.img"
    images.make(image, 4 * MEGABYTE)
    device = volumes.attach(str(image))
    with pytest.raises(OSError, match="its image is mounted"):
        volumes.attach(str(image))
    os.close(device)
    images.wait_until_unused(image, time.monotonic() + 30)
    os.close(volumes.attach(str(image)))
    images.wait_until_unused(image, time.monotonic() + 30)


@ROOT
def test_all_files_are_given_with_little_memory(tmp_path: Path) -> None:
    """The container's limit of memory counts, and a user may have any number of files."""
    outside = tmp_path / "outside"
    outside.write_text("of the machine")
    root = tmp_path / "volume"
    root.mkdir()
    deep = root
    for _ in range(100):
        deep /= "d"
        deep.mkdir()
    for number in range(5000):
        (root / f"{number}-{'x' * 200}").touch()
    (deep / "link").symlink_to(outside)
    tracemalloc.start()
    try:
        volumes._give(str(root), OWNER)
        _, most = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert most < 100_000
    assert {path.lstat().st_uid for path in (root, *root.rglob("*"))} == {OWNER}
    assert outside.stat().st_uid == 0


@ROOT
def test_an_interrupted_gift_is_repeated(tmp_path: Path) -> None:
    """Also for the former owner, who has only some of the files then."""
    root, deep = tmp_path / "volume", tmp_path / "volume"
    root.mkdir()
    volumes._give(str(root), OWNER)
    (root / "file").touch()
    for _ in range(505):
        deep /= "d"
        deep.mkdir()
    with pytest.raises(OSError, match="nested more than 500 deep"):
        volumes._give(str(root), OWNER + 1)
    deep.rmdir()
    for _ in range(10):
        deep = deep.parent
        deep.rmdir()
    volumes._give(str(root), OWNER)
    assert {path.lstat().st_uid for path in (root, *root.rglob("*"))} == {OWNER}
