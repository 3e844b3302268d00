"""Volumes as file systems of their size, in image files.

The container's own mounts hold the only mount of an image (:mod:`rce_container.forkserver.volumes`), so it
ends with the container, however that ends. Whatever writes to an image, a loop device or a program, holds a
lock on its file meanwhile. All functions block.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
import struct
import subprocess
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from rce_container.exceptions import VolumeError

_MAKE = ("mkfs.ext4", "-q", "-F", "-m", "0", "-E", "nodiscard,lazy_itable_init=1")
_CHECK = ("e2fsck", "-f", "-p")
_GROW = ("resize2fs",)
_PROBE_TIMEOUT_S = 60.0
_POLL_S = 0.02
_SUPERBLOCK = 1024
"""Offset of ext4's superblock; the fields below are relative to it (Linux, ``fs/ext4/ext4.h``)."""
_SUPERBLOCK_BYTES = 1024
_MAGIC = 0xEF53
_PROBE_BYTES = 4 << 20


def unavailable() -> str:
    """Say why this machine cannot mount images; empty if it can."""
    if os.geteuid() != 0:
        return "it needs root"
    missing = [
        one for one in (_MAKE[0], _CHECK[0], _GROW[0], "unshare", "mount") if shutil.which(one) is None
    ]
    if missing:
        return f"{', '.join(missing)} not found (Debian, Ubuntu: apt install e2fsprogs util-linux mount)"
    if not Path("/dev/loop-control").exists():
        return "there are no loop devices (/dev/loop-control)"
    with tempfile.TemporaryDirectory() as scratch:
        image, point = Path(scratch) / "image", Path(scratch) / "point"
        point.mkdir()
        try:
            make(image, _PROBE_BYTES)
            mount = ("unshare", "-m", "mount", "-o", "loop,nosuid,nodev")
            _run(*mount, str(image), str(point), timeout=_PROBE_TIMEOUT_S)
            wait_until_unused(image, time.monotonic() + _PROBE_TIMEOUT_S)
        except VolumeError as error:
            return str(error)
    return ""


def make(image: Path, size: int) -> None:
    """Make an image with an empty file system; its room is taken from the disk at once.

    Raises:
        VolumeError: The disk has not enough room, or the file system cannot be made.
    """
    new = image.with_suffix(".new")
    new.unlink(missing_ok=True)  # a program of a killed manager may still write to that one
    try:
        _extend(new, size)
        _run(*_MAKE, str(new))
        new.replace(image)
    finally:
        new.unlink(missing_ok=True)


def grow(image: Path, size: int, deadline: float) -> None:
    """Enlarge an image that is not mounted; one that is large enough stays as it is.

    Takes as long as the programs need: one that is killed while it writes destroys the file system.

    Args:
        image: The image.
        size: Bytes.
        deadline: Until when to wait if another program has it; seconds of the monotonic clock.

    Raises:
        VolumeError: The disk has not enough room, the file system is damaged, or another program has it.
    """
    with _locked(image, deadline) as lock:
        if image.stat().st_size >= size and not _is_smaller_inside(image):
            return
        _extend(image, size)
        _run(*_CHECK, str(image), ok=(0, 1), lock=lock)  # 1: faults were found and corrected
        _run(*_GROW, str(image), lock=lock)


@contextlib.contextmanager
def _locked(image: Path, deadline: float) -> Iterator[int]:
    """Lock an image; yield the descriptor, which its programs inherit.

    So a program that outlives a killed manager keeps the lock.
    """
    fd = os.open(image, os.O_RDWR | os.O_CLOEXEC | os.O_NOFOLLOW)
    try:
        while True:
            try:
                fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                if time.monotonic() > deadline:
                    raise VolumeError(
                        f"the volume {image.stem!r} is in use: a program that an earlier manager started "
                        "is still enlarging it, or it is mounted"
                    ) from error
                time.sleep(_POLL_S)
            else:
                break
        yield fd
    finally:
        os.close(fd)


def wait_until_unused(image: Path, deadline: float) -> None:
    """Wait until no container has an image mounted: the kernel writes the last data after its end.

    Args:
        image: The image.
        deadline: Seconds of the monotonic clock.

    Raises:
        VolumeError: It is mounted still.
    """
    while is_attached(image):
        if time.monotonic() > deadline:
            raise VolumeError(f"the volume {image.stem!r} of a former container is still mounted")
        time.sleep(_POLL_S)


def is_attached(image: Path) -> bool:
    """Whether a loop device has an image."""
    wanted = str(image.resolve())
    for file in Path("/sys/block").glob("loop*/loop/backing_file"):
        try:
            if file.read_text().strip() == wanted:
                return True
        except OSError:  # detached just now
            continue
    return False


def is_on(image: Path, device: int) -> bool:
    """Whether a device, as in ``st_dev``, is the loop device of an image."""
    file = Path(f"/sys/dev/block/{os.major(device)}:{os.minor(device)}/loop/backing_file")
    try:
        return file.read_text().strip() == str(image.resolve())
    except OSError:  # it is not a loop device
        return False


def used(image: Path) -> int:
    """Return how many bytes the files of an image that is not mounted take.

    Raises:
        VolumeError: No file system is in it.
    """
    block = _superblock(image)
    free, overhead = (int(struct.unpack_from("<I", block, offset)[0]) for offset in (0xC, 0x248))
    return max(0, _blocks(block) - free - overhead) * _block_size(block)


def _is_smaller_inside(image: Path) -> bool:
    """Whether the file grew, but not the file system in it: growing was interrupted."""
    block = _superblock(image)
    return (_blocks(block) + 1) * _block_size(block) <= image.stat().st_size


def _superblock(image: Path) -> bytes:
    with image.open("rb") as file:
        file.seek(_SUPERBLOCK)
        block = file.read(_SUPERBLOCK_BYTES)
    if len(block) < _SUPERBLOCK_BYTES or struct.unpack_from("<H", block, 0x38) != (_MAGIC,):
        raise VolumeError(f"{image} does not hold a file system")
    return block


def _blocks(block: bytes) -> int:
    low, high = struct.unpack_from("<I", block, 0x4)[0], struct.unpack_from("<I", block, 0x150)[0]
    return int(low | high << 32)


def _block_size(block: bytes) -> int:
    return 1024 << int(struct.unpack_from("<I", block, 0x18)[0])


def _extend(file: Path, size: int) -> None:
    fd = os.open(file, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    try:
        os.posix_fallocate(fd, 0, size)
    except OSError as error:
        raise VolumeError(
            f"the disk has no room for a volume of {size >> 20} MB: {error.strerror}"
        ) from error
    finally:
        os.close(fd)


def _run(
    *command: str, ok: tuple[int, ...] = (0,), timeout: float | None = None, lock: int | None = None
) -> None:
    """Run a program, which survives the end of this one and signals of its terminal.

    Its output goes to a file: a pipe would end it with SIGPIPE after the end of this program.
    """
    try:
        with tempfile.TemporaryFile("w+", errors="replace") as output:
            done = subprocess.run(  # noqa: S603
                command,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
                timeout=timeout,
                check=False,
                pass_fds=() if lock is None else (lock,),
                start_new_session=True,
            )
            output.seek(0)
            words = output.read().strip().splitlines()[-1:]
    except (OSError, subprocess.TimeoutExpired) as error:
        raise VolumeError(f"{command[0]}: {error}") from error
    if done.returncode not in ok:
        raise VolumeError(f"{command[0]} failed with {done.returncode}: {' '.join(words)}")
