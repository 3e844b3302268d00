"""Runs a Python script in a forked process, as ``python SCRIPT`` runs it in a new one."""

from __future__ import annotations

import atexit
import contextlib
import io
import os
import signal
import sys
import threading
from collections.abc import Sequence
from importlib.machinery import SourceFileLoader
from types import ModuleType
from typing import Any, BinaryIO, cast

_CANNOT_OPEN = 2
"""The exit code of a Python that cannot open its script."""


def open_streams(*, unbuffered: bool) -> None:
    """Recreate the standard streams, on the descriptors 0, 1 and 2."""

    def text(fd: int, **how: Any) -> io.TextIOWrapper:
        raw = io.FileIO(fd, "w", closefd=False)
        binary = cast("BinaryIO", raw) if unbuffered else io.BufferedWriter(raw)
        return io.TextIOWrapper(binary, "utf-8", write_through=unbuffered, **how)

    streams = {
        "stdin": io.TextIOWrapper(io.BufferedReader(io.FileIO(0, closefd=False)), "utf-8"),
        "stdout": text(1),
        "stderr": text(2, errors="backslashreplace", line_buffering=True),
    }
    for name, stream in streams.items():
        setattr(sys, name, stream)
        setattr(sys, f"__{name}__", stream)


def run_script(path: str, arguments: Sequence[str]) -> None:
    """Run a script as Python's main program. Return when the script ends, for the process to end.

    Raises:
        SystemExit: The script says how to end, or fails.
    """
    sys.argv = [path, *arguments]
    sys.path.insert(0, os.path.dirname(os.path.realpath(path)))  # noqa: PTH120 - exactly as Python does
    main = ModuleType("__main__")
    main.__dict__.update(
        __file__=path,
        __builtins__=__builtins__,
        __loader__=SourceFileLoader("__main__", path),
        __cached__=None,
        __annotations__={},
    )
    sys.modules["__main__"] = main
    try:
        with io.open_code(path) as file:
            source = file.read()
    except OSError as error:
        sys.stderr.write(
            f"{sys.executable}: can't open file {path!r}: [Errno {error.errno}] {error.strerror}\n"
        )
        raise SystemExit(_CANNOT_OPEN) from None
    try:
        exec(compile(source, path, "exec", dont_inherit=True), main.__dict__)  # noqa: S102 - it is what was asked
    except SystemExit:
        raise
    except BaseException as error:  # noqa: BLE001 - told as Python tells it, without our own frame
        trace = error.__traceback__.tb_next if error.__traceback__ is not None else None
        sys.excepthook(type(error), error.with_traceback(trace), trace)
        if isinstance(error, KeyboardInterrupt):
            _die_interrupted()
        raise SystemExit(1) from None


def _die_interrupted() -> None:
    """End by SIGINT after Python's normal shutdown, so that the parent sees the reason."""
    threading._shutdown()  # type: ignore[attr-defined]  # noqa: SLF001 - what the interpreter calls itself
    atexit._run_exitfuncs()  # noqa: SLF001
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):
            stream.flush()
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    os.kill(os.getpid(), signal.SIGINT)
