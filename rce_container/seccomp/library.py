"""Translates the list of system calls into a program for the kernel, with libseccomp."""

from __future__ import annotations

import ctypes
import os
import tempfile
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from rce_container.seccomp.calls import ALLOWED, CONDITIONAL, DENIED, INVISIBLE, PRETENDED, REFUSED, Match

LIBRARY = "libseccomp.so.2"

_ALLOW = 0x7FFF_0000
_ERRNO = 0x0005_0000
_KILL_PROCESS = 0x8000_0000
_ATTRIBUTE_BAD_ARCHITECTURE = 2
_ATTRIBUTE_OPTIMIZE = 8
_AS_A_TREE = 2
_MASKED_EQUAL = 7
_UNKNOWN = -1


class FilterUnavailableError(Exception):
    """A filter cannot be made on this machine; the text says why."""


class _Comparison(ctypes.Structure):
    """``struct scmp_arg_cmp``."""

    _fields_ = (
        ("argument", ctypes.c_uint),
        ("operation", ctypes.c_int),
        ("first", ctypes.c_uint64),
        ("second", ctypes.c_uint64),
    )


def make_filter() -> bytes:
    """Make the filter of system calls for this machine's processor.

    A process that makes calls as another architecture (32-bit programs) is killed.

    Returns:
        Instructions, for :func:`rce_container.forkserver.kernel.filter_calls`.

    Raises:
        FilterUnavailableError: libseccomp is missing, or fails.
    """
    try:
        library = ctypes.CDLL(LIBRARY)
    except OSError as error:
        raise FilterUnavailableError(
            f"{LIBRARY} is missing (Debian, Ubuntu: apt install libseccomp2)"
        ) from error
    library.seccomp_init.restype = ctypes.c_void_p
    library.seccomp_init.argtypes = (ctypes.c_uint32,)
    context = library.seccomp_init(_ERRNO | INVISIBLE)
    if not context:
        raise FilterUnavailableError(f"{LIBRARY} knows nothing of this processor")
    try:
        return _translate(library, ctypes.c_void_p(context))
    finally:
        library.seccomp_release(ctypes.c_void_p(context))


def _translate(library: ctypes.CDLL, context: ctypes.c_void_p) -> bytes:
    _check(library.seccomp_attr_set, context, _ATTRIBUTE_BAD_ARCHITECTURE, ctypes.c_uint32(_KILL_PROCESS))
    # An older library makes a linear list of conditions, which is slower.
    library.seccomp_attr_set(context, _ATTRIBUTE_OPTIMIZE, ctypes.c_uint32(_AS_A_TREE))
    add = partial(_add, library, context)
    for call in ALLOWED:
        add(_ALLOW, call)
    for rule in CONDITIONAL:
        add(_ALLOW, rule.call, rule.matches)
    for call in REFUSED:
        add(_ERRNO | DENIED, call)
    for call in PRETENDED:
        add(_ERRNO, call)
    with tempfile.TemporaryFile() as file:
        _check(library.seccomp_export_bpf, context, file.fileno())
        return os.pread(file.fileno(), os.fstat(file.fileno()).st_size, 0)


def _add(
    library: ctypes.CDLL, context: ctypes.c_void_p, action: int, call: str, matches: Sequence[Match] = ()
) -> None:
    number = library.seccomp_syscall_resolve_name(call.encode())
    if number == _UNKNOWN:
        return
    comparisons = (_Comparison * max(1, len(matches)))(
        *(_Comparison(one.argument, _MASKED_EQUAL, one.mask, one.value) for one in matches)
    )
    _check(
        library.seccomp_rule_add_array, context, ctypes.c_uint32(action), number, len(matches), comparisons
    )


def _check(function: Callable[..., int], *arguments: Any) -> None:
    code = function(*arguments)
    if code < 0:
        raise FilterUnavailableError(f"{LIBRARY} fails: {os.strerror(-code)}")
