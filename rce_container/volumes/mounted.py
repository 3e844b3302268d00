"""Opens the file system in an image while no container has it. All functions block."""

from __future__ import annotations

import contextlib
import os
import threading
from pathlib import Path

from rce_container.exceptions import VolumeError
from rce_container.forkserver import kernel
from rce_container.forkserver.kernel import Mount, Namespaces
from rce_container.forkserver.volumes import OPTIONS, attach

_FLAGS = Mount.NO_SUID | Mount.NO_DEV | Mount.NO_EXEC


def open_image(image: Path, point: Path, *, read_only: bool) -> int:
    """Mount an image where only this program sees it, until the returned descriptor is closed.

    A thread mounts it in a namespace of its own and ends. The descriptor keeps the mount alive, and nothing
    else does: it ends with this program too.

    Args:
        image: The image.
        point: An empty folder.
        read_only: Whether files are read only.

    Returns:
        A descriptor of its root folder.

    Raises:
        VolumeError: It cannot be mounted.
    """
    found: list[int] = []
    faults: list[OSError] = []

    def work() -> None:
        try:
            found.append(_open(image, point, read_only=read_only))
        except OSError as error:
            faults.append(error)

    thread = threading.Thread(target=work, name=f"mount {image.name}")
    thread.start()
    thread.join()
    if faults:
        raise VolumeError(f"the file system in {image.name} cannot be mounted: {faults[0]}") from faults[0]
    return found[0]


def _open(image: Path, point: Path, *, read_only: bool) -> int:
    kernel.unshare(Namespaces.MOUNT)
    kernel.mount("/", Mount.PRIVATE | Mount.RECURSIVE)
    flags = _FLAGS | Mount.READ_ONLY if read_only else _FLAGS
    device = attach(str(image))
    try:
        kernel.mount(str(point), flags, source=f"/proc/self/fd/{device}", kind="ext4", options=OPTIONS)
    finally:
        os.close(device)
    return os.open(point, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)


def open_inside(pid: int, path: str) -> int:
    """Open a folder of a running container, following no link that a node may have made.

    Args:
        pid: A process in its namespaces.
        path: Where the container sees the folder; absolute.

    Raises:
        OSError: It cannot be opened.
    """
    folder = os.open(f"/proc/{pid}/root", os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        for name in path.strip("/").split("/"):
            inner = os.open(name, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC | os.O_NOFOLLOW, dir_fd=folder)
            os.close(folder)
            folder = inner
    except OSError:
        with contextlib.suppress(OSError):
            os.close(folder)
        raise
    return folder
