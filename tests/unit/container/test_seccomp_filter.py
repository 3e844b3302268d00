"""The filter of system calls, by a small interpreter of the kernel's classic BPF."""

from __future__ import annotations

import ctypes
import errno
import platform
import socket
import struct

import pytest

from rce_container.forkserver.kernel import Namespaces
from rce_container.seccomp.calls import ALLOWED, CONDITIONAL, PRETENDED, REFUSED
from rce_container.seccomp.library import LIBRARY, FilterUnavailableError, make_filter

ARCHITECTURES = {"x86_64": 0xC000_003E, "aarch64": 0xC000_00B7}
ALLOW, DENIED, INVISIBLE, KILL = 0x7FFF_0000, 0x5_0000 | errno.EPERM, 0x5_0000 | errno.ENOSYS, 0x8000_0000
THREAD = 0x3D_0F00
"""What a C library clones a thread with."""

pytestmark = pytest.mark.skipif(
    platform.machine() not in ARCHITECTURES, reason="knows the numbers of two architectures only"
)


@pytest.fixture(scope="module")
def program() -> bytes:
    try:
        return make_filter()
    except FilterUnavailableError as error:
        pytest.skip(str(error))


def number(call: str) -> int:
    return int(ctypes.CDLL(LIBRARY).seccomp_syscall_resolve_name(call.encode()))


def run(program: bytes, data: bytes) -> int:
    """Run a filter on a ``struct seccomp_data``; returns its verdict."""
    code = list(struct.iter_unpack("=HBBI", program))
    accumulator = at = 0
    while True:
        operation, true, false, k = code[at]
        at += 1
        jumps = {
            0x15: accumulator == k,
            0x25: accumulator > k,
            0x35: accumulator >= k,
            0x45: bool(accumulator & k),
        }
        if operation == 0x20:
            (accumulator,) = struct.unpack_from("=I", data, k)
        elif operation == 0x54:
            accumulator &= k
        elif operation == 0x05:
            at += k
        elif operation in jumps:
            at += true if jumps[operation] else false
        else:
            assert operation == 0x06, f"unknown instruction {operation:#x}"
            return int(k)


def verdict(program: bytes, call: str, *arguments: int, machine: str = "") -> int:
    words = (*arguments, 0, 0, 0, 0, 0, 0)[:6]
    architecture = ARCHITECTURES[machine or platform.machine()]
    return run(program, struct.pack("=iIQ6Q", number(call), architecture, 0, *words))


@pytest.mark.parametrize("call", ["read", "openat", "execve", "futex", "epoll_pwait2", "rseq", "getrandom"])
def test_ordinary_calls_are_allowed(program: bytes, call: str) -> None:
    assert verdict(program, call) == ALLOW


@pytest.mark.parametrize("call", [call for call in REFUSED if number(call) >= 0])
def test_privileged_calls_are_denied(program: bytes, call: str) -> None:
    assert verdict(program, call) == DENIED


def test_what_is_not_named_does_not_exist(program: bytes) -> None:
    assert verdict(program, "clone3") == INVISIBLE
    unheard_of = struct.pack("=iIQ6Q", 9999, ARCHITECTURES[platform.machine()], 0, *[0] * 6)
    assert run(program, unheard_of) == INVISIBLE


def test_threads_are_allowed_namespaces_are_not(program: bytes) -> None:
    """Threads and processes are allowed and namespaces are not."""
    assert verdict(program, "clone", THREAD) == ALLOW
    assert verdict(program, "unshare", 0x400) == ALLOW
    for kind in (*Namespaces, 0x80):
        assert verdict(program, "unshare", kind) == INVISIBLE
        assert verdict(program, "clone", THREAD | kind) == INVISIBLE


@pytest.mark.parametrize(
    ("family", "protocol", "allowed"),
    [
        (socket.AF_UNIX, 0, True),
        (socket.AF_INET, 0, True),
        (socket.AF_INET6, 0, True),
        (socket.AF_INET | 1 << 32, 0, True),
        (socket.AF_NETLINK, 0, True),
        (socket.AF_NETLINK, 9, False),
        (socket.AF_PACKET, 0, False),
        (40, 0, False),
        (38, 0, False),
    ],
)
def test_sockets_are_of_a_few_families(program: bytes, family: int, protocol: int, allowed: bool) -> None:
    assert (verdict(program, "socket", family, 2, protocol) == ALLOW) is allowed


@pytest.mark.parametrize("call", PRETENDED)
def test_disks_are_not_made_to_write(program: bytes, call: str) -> None:
    assert verdict(program, call) == 0x5_0000, "it succeeds and does nothing"


@pytest.mark.parametrize(
    ("call", "arguments", "allowed"),
    [
        ("mmap", (0, 4096, 3, 0x22), True),
        ("mmap", (0, 4096, 3, 0x4_0022), False),
        ("memfd_create", (0, 3), True),
        ("memfd_create", (0, 4), False),
        ("shmget", (0, 4096, 0o1600), True),
        ("shmget", (0, 4096, 0o5600), False),
    ],
)
def test_huge_pages_are_not_to_be_had(
    program: bytes, call: str, arguments: tuple[int, ...], allowed: bool
) -> None:
    assert (verdict(program, call, *arguments) == ALLOW) is allowed


@pytest.mark.parametrize("command", [0, 4, 6, 7, 38, 1025, 1030, 1032, 1033, 1038])
def test_files_can_be_controlled(program: bytes, command: int) -> None:
    assert verdict(program, "fcntl", 3, command) == ALLOW
    assert verdict(program, "fcntl", 3, command | 1 << 40) == ALLOW, "the kernel does not look there"


@pytest.mark.parametrize("command", [1024, 1024 | 1 << 40, 64, 2048])
def test_files_cannot_be_leased(program: bytes, command: int) -> None:
    assert verdict(program, "fcntl", 3, command) == INVISIBLE


def test_another_architectures_calls_kill(program: bytes) -> None:
    other = next(name for name in ARCHITECTURES if name != platform.machine())
    assert verdict(program, "read", machine=other) == KILL


def test_no_call_is_listed_twice() -> None:
    calls = (*ALLOWED, *REFUSED, *PRETENDED, *{rule.call for rule in CONDITIONAL})
    assert len(calls) == len(set(calls))
