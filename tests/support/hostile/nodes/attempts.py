"""Tries attacks, each in a process of its own, and says how each one ended. Uses nothing of the engine."""

from __future__ import annotations

import ctypes
import errno
import os
import select
import signal
from collections.abc import Callable, Mapping
from pathlib import Path

Attack = Callable[[], object]

DONE = "done"
HANGS = "hangs"
_TIMEOUT_S = 5.0
_MAX_SILENCES = 12
_MAX_RESULT = 1 << 16

libc = ctypes.CDLL(None, use_errno=True)
_seccomp = ctypes.CDLL("libseccomp.so.2")


def system(name: str, *arguments: object) -> int:
    """Make a system call by its name.

    Raises:
        OSError: It is refused.
    """
    number = _seccomp.seccomp_syscall_resolve_name(name.encode())
    ctypes.set_errno(0)
    found = libc.syscall(ctypes.c_long(number), *map(_argument, arguments))
    if found == -1:
        code = ctypes.get_errno()
        raise OSError(code, f"{name}: {os.strerror(code)}")
    return int(found)


def _argument(value: object) -> object:
    return ctypes.c_long(value) if isinstance(value, int) else value


def attempt_all(attacks: Mapping[str, Attack]) -> dict[str, str]:
    """Try one after the other; see :func:`attempt`."""
    return {name: attempt(attack) for name, attack in attacks.items()}


def attempt(attack: Attack, timeout: float = _TIMEOUT_S) -> str:
    """Try an attack in a child.

    Args:
        attack: What to try.
        timeout: Seconds of silence after which it hangs, if it did not even use the processor meanwhile: a
            machine may be busy.

    Returns:
        What it returned, or :data:`DONE`; the name of the error or of the signal that ended it.
    """
    ours, theirs = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(ours)
        os.write(theirs, _try(attack).encode()[:_MAX_RESULT])
        os._exit(0)
    os.close(theirs)
    said, worked, silences = b"", 0, 0
    while True:
        if select.select((ours,), (), (), timeout)[0]:
            piece = os.read(ours, _MAX_RESULT)
            if not piece:
                break
            said += piece
            continue
        before, worked = worked, _ticks(child)
        silences += 1
        if worked == before or silences > _MAX_SILENCES:
            said = HANGS.encode()
            os.kill(child, signal.SIGKILL)
            break
    os.close(ours)
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    return said.decode() or (signal.Signals(-code).name if code < 0 else f"exit {code}")


def _ticks(pid: int) -> int:
    """What a child has used of the processor; 0 if that cannot be seen."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0
    return int(fields[11]) + int(fields[12])


def _try(attack: Attack) -> str:
    try:
        found = attack()
    except OSError as error:
        return errno.errorcode.get(error.errno or 0, str(error))
    except Exception as error:  # noqa: BLE001 - whatever it is, it is a result
        return f"{type(error).__name__}: {error}"
    return DONE if found is None or isinstance(found, int) else str(found)


def find_process(word: str) -> int:
    """The first process that was started with this argument; 0 if none is to be seen."""
    for path in sorted(Path("/proc").glob("[0-9]*"), key=lambda path: int(path.name)):
        try:
            words = (path / "cmdline").read_bytes().split(b"\0")
        except OSError:
            continue
        if word.encode() in words and int(path.name) != os.getpid():
            return int(path.name)
    return 0
