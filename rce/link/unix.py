"""Unix sockets in the file system: private, and cleaned up."""

from __future__ import annotations

import contextlib
import errno
import os
import socket
import stat
import time
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path


_YOUNG_S = 60.0


def bind_private(path: Path) -> tuple[socket.socket, int]:
    """Bind a unix socket that only this user may use; return it and the inode of its file."""
    _remove_stale_socket(path)
    sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        sock.setblocking(False)
        sock.bind(str(path))
        path.chmod(stat.S_IRUSR | stat.S_IWUSR)  # before it listens, so no process can connect earlier
    except BaseException:
        sock.close()
        raise
    return sock, path.stat().st_ino


def unlink_own(path: Path, inode: int) -> None:
    """Remove a socket file unless another process has put its own there."""
    with contextlib.suppress(FileNotFoundError):
        if path.stat().st_ino == inode:
            path.unlink()


def _remove_stale_socket(path: Path) -> None:
    """Remove the socket file of a process that is gone.

    Raises:
        OSError: The path is not a socket, or another process listens there.
    """
    try:
        mode = path.stat().st_mode
    except FileNotFoundError:
        return
    if not stat.S_ISSOCK(mode):
        raise FileExistsError(errno.EEXIST, "exists and is not a socket", str(path))
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.setblocking(False)
        try:
            probe.connect(str(path))
        except ConnectionRefusedError:
            path.unlink()
            return
        except BlockingIOError:
            pass
    raise OSError(errno.EADDRINUSE, "another process listens here", str(path))


def socket_name(name: str) -> str:
    """Name a socket file of this process, so that it can be told later whether the process still runs."""
    return f"{name}.{os.getpid()}.sock"


def remove_stale_sockets(folder: Path, pattern: str) -> None:
    """Remove socket files that killed processes left behind.

    Young ones may just be about to listen, unless their names say that their process has ended.
    """
    for path in folder.glob(pattern):
        with contextlib.suppress(OSError):  # a process listens there, or another one removed it first
            if _owner_ended(path) or time.time() - path.stat().st_mtime > _YOUNG_S:
                _remove_stale_socket(path)


def _owner_ended(path: Path) -> bool:
    pid = path.stem.rpartition(".")[2]
    if not pid.isdecimal():
        return False
    try:
        os.kill(int(pid), 0)
    except ProcessLookupError:
        return True
    except (PermissionError, OverflowError):
        pass
    return False
