"""Network namespaces as descriptors, and the program ``ip`` run in them. Everything here blocks."""

from __future__ import annotations

import contextlib
import ctypes
import os
import shutil
import subprocess
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TypeVar

from rce_container.exceptions import NetworkError

_CLONE_NEWNET = 0x40000000
_TIMEOUT_S = 20.0
_IPV6 = Path("/proc/sys/net/ipv6/conf/default/disable_ipv6")

T = TypeVar("T")


def make_namespace() -> int:
    """Make a network namespace; it exists as long as the returned descriptor or its copies.

    Raises:
        NetworkError: This process lacks the permission.
    """
    return _in_thread(_unshare)


def open_namespace(pid: int) -> int:
    """Open the network namespace that a container's process is in.

    Raises:
        NetworkError: The process has ended, or does not have its own network namespace.
    """
    try:
        fd = os.open(f"/proc/{pid}/ns/net", os.O_RDONLY | os.O_CLOEXEC)
    except OSError as error:
        raise NetworkError(f"the container's network cannot be opened: {error.strerror}") from error
    if os.path.samestat(os.fstat(fd), os.stat("/proc/self/ns/net")):  # noqa: PTH116 - beside fstat
        os.close(fd)
        raise NetworkError("the container has no network namespace of its own")
    return fd


def configure(namespace: int, commands: Sequence[str], *, others: Sequence[int] = ()) -> None:
    """Run commands of ``ip`` in a namespace, without IPv6 on the interfaces that they make.

    Args:
        namespace: Descriptor of it.
        commands: Lines as ``ip -batch`` takes them; the first that fails ends it.
        others: Descriptors of further namespaces, which a command names as ``/proc/self/fd/N``.

    Raises:
        NetworkError: A command fails, or ``ip`` is not installed.
    """
    _in_thread(lambda: _configure(namespace, commands, others))


def _in_thread(action: Callable[[], T]) -> T:
    """Call a function in a separate thread, which may change its namespaces until it ends."""
    with ThreadPoolExecutor(1, thread_name_prefix="namespace") as pool:
        return pool.submit(action).result()


def _unshare() -> int:
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.unshare(_CLONE_NEWNET):
        raise NetworkError(f"network namespaces cannot be made: {os.strerror(ctypes.get_errno())}")
    return os.open("/proc/thread-self/ns/net", os.O_RDONLY | os.O_CLOEXEC)


def _configure(namespace: int, commands: Sequence[str], others: Sequence[int]) -> None:
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.setns(namespace, _CLONE_NEWNET):
        raise NetworkError(f"a network namespace cannot be entered: {os.strerror(ctypes.get_errno())}")
    with contextlib.suppress(FileNotFoundError):  # a kernel without IPv6
        _IPV6.write_text("1")
    ip = shutil.which("ip", path=f"{os.environ.get('PATH', os.defpath)}:/usr/sbin:/sbin")
    if ip is None:
        raise NetworkError("the program ip is not installed (Debian, Ubuntu: apt install iproute2)")
    try:
        found = subprocess.run(  # noqa: S603
            [ip, "-batch", "-"],
            input="".join(f"{command}\n" for command in commands),
            capture_output=True,
            text=True,
            timeout=_TIMEOUT_S,
            check=False,
            pass_fds=others,
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise NetworkError(f"{ip} does not work: {error}") from error
    if found.returncode:
        words = found.stderr.strip().splitlines()
        raise NetworkError(f"ip: {'; '.join(words) or f'exit code {found.returncode}'}")
