"""Mounts the volumes of a container inside it, and gives them to its user.

The loop device of an image detaches itself when its only mount ends, which is in the container's namespaces:
nothing is left on the machine, whichever process is killed.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import stat
import struct
import time
from collections.abc import Iterator, Sequence

from rce_container.descent import FOLDER, MAX_DEPTH
from rce_container.forkserver.kernel import Mount, mount
from rce_container.forkserver.messages import VolumeOrder

# Linux, include/uapi/linux/loop.h
_CONTROL_GET_FREE = 0x4C82
_CONFIGURE = 0x4C0A
_AUTOCLEAR = 4
_CONFIG = struct.Struct("=II 5Q 4I 64s 64s 32s 2Q 8Q")
_ATTEMPTS = 64
_LOCK_S = 2.0
_LOCK_PAUSE_S = 0.01
_FLAGS = Mount.NO_SUID | Mount.NO_DEV
OPTIONS = "noinit_itable"
"""Options of a mount; without it the kernel would free space of the image that is reserved for inodes."""


@contextlib.contextmanager
def attached(volumes: Sequence[VolumeOrder]) -> Iterator[list[tuple[VolumeOrder, int]]]:
    """Attach the images to loop devices; to be entered while the machine's files can be seen.

    Yields:
        Each volume, with a descriptor of its device; -1 for one that is a folder and mounted already.

    Raises:
        OSError: An image cannot be attached.
    """
    with contextlib.ExitStack() as stack:
        found: list[tuple[VolumeOrder, int]] = []
        for volume in volumes:
            device = attach(volume.image) if volume.image else -1
            if device >= 0:
                stack.callback(os.close, device)
            found.append((volume, device))
        yield found


def mount_volumes(volumes: Sequence[tuple[VolumeOrder, int]], procfs: int, owner: int) -> None:
    """Mount the volumes, and give all of their files to the container's user.

    Args:
        volumes: As :func:`attached` yields them.
        procfs: A descriptor of the machine's ``/proc``.
        owner: User and group outside of the container.

    Raises:
        OSError: A file system cannot be mounted.
    """
    for volume, device in volumes:
        if device >= 0:
            os.fchdir(procfs)  # the container's own /proc does not know this process
            try:
                mount(volume.path, _FLAGS, source=f"self/fd/{device}", kind="ext4", options=OPTIONS)
            except OSError as error:
                raise OSError(error.errno, f"volume at {volume.path}: {error.strerror}") from error
            finally:
                os.chdir("/")
            with contextlib.suppress(OSError):
                os.rmdir(os.path.join(volume.path, "lost+found"))  # noqa: PTH106, PTH118 - like its neighbours
        _give(volume.path, owner)


def attach(image: str) -> int:
    """Attach an image to a free loop device; return a descriptor of the device.

    The device keeps the file's lock until it is detached, so that an image is never attached twice, nor while
    a program enlarges it.

    Raises:
        OSError: It cannot be attached, or is in use.
    """
    file = os.open(image, os.O_RDWR | os.O_CLOEXEC | os.O_NOFOLLOW)
    try:
        _lock(file)
    except OSError:
        os.close(file)
        raise
    control = os.open("/dev/loop-control", os.O_RDWR | os.O_CLOEXEC)
    try:
        for _ in range(_ATTEMPTS):
            number = fcntl.ioctl(control, _CONTROL_GET_FREE)
            device = os.open(f"/dev/loop{number}", os.O_RDWR | os.O_CLOEXEC)
            name = os.fsencode(image)[:63]
            config = _CONFIG.pack(file, 0, *[0] * 5, *(0, 0, 0, _AUTOCLEAR), name, b"", b"", *[0] * 10)
            try:
                fcntl.ioctl(device, _CONFIGURE, config)
            except OSError as error:
                os.close(device)
                if error.errno != errno.EBUSY:  # another container took this device
                    raise
            else:
                return device
        raise OSError(errno.EBUSY, "no loop device is free")
    finally:
        os.close(control)
        os.close(file)


def _lock(image: int) -> None:
    """Lock an image; the kernel may need a moment to detach it after its former use."""
    deadline = time.monotonic() + _LOCK_S
    while True:
        try:
            fcntl.flock(image, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            if time.monotonic() > deadline:
                raise OSError(errno.EBUSY, "its image is mounted, or a program is enlarging it") from error
            time.sleep(_LOCK_PAUSE_S)
        else:
            return


def _give(folder: str, owner: int) -> None:
    """Give a folder and what is in it to a user; each container may run as another one. Follows no links.

    Keeps no names: this process counts for the container's limit of memory. No other process changes the
    folder meanwhile.
    """
    if os.lstat(folder).st_uid == owner:
        return
    os.chown(folder, os.geteuid(), -1)  # the owner's at last: an interrupted change is repeated
    fd = os.open(folder, FOLDER)
    levels = [os.scandir(fd)]
    try:
        while levels:
            if (entry := next(levels[-1], None)) is None:
                levels.pop().close()
                fd = _replace(fd, "..") if levels else fd
                continue
            os.chown(entry.name, owner, owner, dir_fd=fd, follow_symlinks=False)
            if stat.S_ISDIR(os.stat(entry.name, dir_fd=fd, follow_symlinks=False).st_mode):
                if len(levels) > MAX_DEPTH:
                    raise OSError(errno.ENAMETOOLONG, f"folders are nested more than {MAX_DEPTH} deep")
                fd = _replace(fd, entry.name)
                levels.append(os.scandir(fd))
    finally:
        for level in levels:
            level.close()
        os.close(fd)
    os.chown(folder, owner, owner)
    os.chmod(folder, 0o700)  # noqa: PTH101 - like its neighbours


def _replace(folder: int, name: str) -> int:
    """Open a folder in, or above, one that is open, and close that one."""
    fd = os.open(name, FOLDER, dir_fd=folder)
    os.close(folder)
    return fd
