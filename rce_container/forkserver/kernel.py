"""System calls that confine a process: namespaces, mounts, capabilities, filters. Linux only.

Each function raises :class:`OSError` if the kernel refuses.
"""

from __future__ import annotations

import ctypes
import fcntl
import os
from collections.abc import Callable
from enum import IntEnum, IntFlag


class Namespaces(IntFlag):
    """Kinds of namespaces, as in ``clone(2)``."""

    MOUNT = 0x0002_0000
    CGROUP = 0x0200_0000
    UTS = 0x0400_0000
    IPC = 0x0800_0000
    USER = 0x1000_0000
    PID = 0x2000_0000
    NET = 0x4000_0000


class Mount(IntFlag):
    """Flags of ``mount(2)``."""

    READ_ONLY = 1
    NO_SUID = 2
    NO_DEV = 4
    NO_EXEC = 8
    REMOUNT = 32
    BIND = 4096
    RECURSIVE = 16384
    PRIVATE = 1 << 18


class _Prctl(IntEnum):
    SET_DUMPABLE = 4
    SET_SECCOMP = 22
    CAPBSET_DROP = 24
    SET_SECUREBITS = 28
    SET_CHILD_SUBREAPER = 36
    SET_NO_NEW_PRIVS = 38
    CAP_AMBIENT = 47


_CAP_AMBIENT_CLEAR_ALL = 4
_SECBIT_NO_SETUID_FIXUP = 4
_CAPABILITY_VERSION_3 = 0x2008_0522
_MNT_DETACH = 2
_FALLOC_FL_KEEP_SIZE = 1
_FALLOC_FL_PUNCH_HOLE = 2
_NS_GET_USERNS = 0xB701
_SECCOMP_MODE_FILTER = 2
_BPF_INSTRUCTION_BYTES = 8

_libc = ctypes.CDLL(None, use_errno=True)

_libc.prctl.argtypes = (ctypes.c_int, *[ctypes.c_ulong] * 4)
_libc.fallocate.argtypes = (ctypes.c_int, ctypes.c_int, ctypes.c_int64, ctypes.c_int64)
_libc.mount.argtypes = (ctypes.c_char_p, ctypes.c_char_p, ctypes.c_char_p, ctypes.c_ulong, ctypes.c_char_p)


class _Program(ctypes.Structure):
    """``struct sock_fprog``."""

    _fields_ = (("length", ctypes.c_ushort), ("instructions", ctypes.c_void_p))


def join(fd: int, kinds: Namespaces) -> None:
    """Join namespaces: those of a process (a pidfd), or an open one.

    A pid namespace is joined by the children that are forked afterwards.
    """
    _check(_libc.setns, fd, int(kinds))


def unshare(kinds: Namespaces) -> None:
    """Move to new namespaces."""
    _check(_libc.unshare, int(kinds))


def owner(namespace: int) -> int:
    """Open the user namespace that an open namespace belongs to; return the descriptor."""
    return fcntl.ioctl(namespace, _NS_GET_USERNS)


def mount(target: str, flags: Mount, *, source: str = "none", kind: str = "", options: str = "") -> None:
    """Mount something, or change how it is mounted."""
    _check(_libc.mount, *map(os.fsencode, (source, target, kind)), int(flags), os.fsencode(options))


def unmount(target: str) -> None:
    """Take a mount out of the tree; descriptors that are open below it stay good."""
    _check(_libc.umount2, os.fsencode(target), _MNT_DETACH)


def sync_file_system(fd: int) -> None:
    """Write all data of the file system of an open file to its disk. Blocks."""
    _check(_libc.syncfs, fd)


def punch_hole(fd: int, offset: int, length: int) -> None:
    """Give the disk space of a part of a file back; the part reads as zeros, and the size stays."""
    _check(_libc.fallocate, fd, _FALLOC_FL_KEEP_SIZE | _FALLOC_FL_PUNCH_HOLE, offset, length)


def set_dumpable(dumpable: bool) -> None:
    """Set whether other processes of the same user may inspect this one, and whether it may dump core."""
    _prctl(_Prctl.SET_DUMPABLE, int(dumpable))


def become_subreaper() -> None:
    """Adopt the orphans of descendants."""
    _prctl(_Prctl.SET_CHILD_SUBREAPER, 1)


def keep_rights_as_another_user() -> None:
    """Keep capabilities across changes of the user, until a new user namespace."""
    _prctl(_Prctl.SET_SECUREBITS, _SECBIT_NO_SETUID_FIXUP)


def give_up_capabilities() -> None:
    """Empty all sets of capabilities, the bounding set included, and gain no rights by executing files."""
    number = 0
    while _libc.prctl(_Prctl.CAPBSET_DROP, number, 0, 0, 0) == 0:
        number += 1
    _prctl(_Prctl.CAP_AMBIENT, _CAP_AMBIENT_CLEAR_ALL)
    header = (ctypes.c_uint32 * 2)(_CAPABILITY_VERSION_3, 0)
    _check(_libc.capset, header, (ctypes.c_uint32 * 6)())
    _prctl(_Prctl.SET_NO_NEW_PRIVS, 1)


def filter_calls(program: bytes) -> None:
    """Load a filter of system calls for this process and all its descendants.

    Args:
        program: Instructions of the kernel's classic BPF, as libseccomp exports them.
    """
    instructions = ctypes.create_string_buffer(program, len(program))
    found = _Program(len(program) // _BPF_INSTRUCTION_BYTES, ctypes.addressof(instructions))
    _prctl(_Prctl.SET_SECCOMP, _SECCOMP_MODE_FILTER, ctypes.addressof(found))


def _prctl(option: _Prctl, first: int, second: int = 0) -> None:
    _check(_libc.prctl, option, first, second, 0, 0)


def _check(function: Callable[..., int], *arguments: object) -> None:
    if function(*arguments) == -1:
        code = ctypes.get_errno()
        raise OSError(code, f"{function.__name__}: {os.strerror(code)}")
