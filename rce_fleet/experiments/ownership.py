"""What experiments leave on the system if they are killed, and how it is found and removed again.

Everything that an experiment makes outside its processes (network namespaces, interfaces, control groups,
folders) has a name that begins with its tag: ``rcx``, the id of its process, a dot and a number.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import re
import shutil
import signal
import subprocess
import tempfile
import time
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING

from rce_fleet.experiments.usage import ROOT, processes_in, processes_in_group, remove_group

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

_TAG = re.compile(r"rcx(\d+)\.\d+")
_numbers = count(1)
END_S = 10.0
"""How long programs that were left over may take to end."""
LOCK = "rce-experiment.lock"
"""File that an experiment has locked while it measures."""


def new_tag() -> str:
    """Return a tag for what this process makes next."""
    return f"rcx{os.getpid()}.{next(_numbers) % 100}"


def is_abandoned(name: str) -> bool:
    """Return whether a name is of an experiment whose process has ended."""
    found = _TAG.match(name)
    return found is not None and not Path(f"/proc/{found[1]}").exists()


def sweep() -> list[str]:
    """Remove what experiments left that were killed; return the names.

    Raises:
        OSError: Something cannot be removed.
    """
    with _alone():
        namespaces = [name for name in _namespaces() if is_abandoned(name)]
        groups = [path for path in _groups() if is_abandoned(path.name)]
        folders = [path for path in Path(tempfile.gettempdir()).glob("rcx*") if is_abandoned(path.name)]
        end_all(lambda: {*_in_namespaces(namespaces), *_in_groups(groups)})
        for name in namespaces:
            _ip("netns", "del", name)
        for name in (name for name in _interfaces() if is_abandoned(name)):
            _ip("link", "del", name)
        for path in groups:
            remove_group(path)
        for path in folders:
            shutil.rmtree(path)
        return [*namespaces, *sorted({path.name for path in groups}), *(path.name for path in folders)]


@contextlib.contextmanager
def measuring() -> Iterator[bool]:
    """Note for the block that this process measures; yield whether no other one on this computer does.

    Two that measure at the same time disturb each other's figures.
    """
    try:
        file = os.open(Path(tempfile.gettempdir()) / LOCK, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    except OSError:  # another user has it
        yield True
        return
    try:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            is_alone = True
        except OSError:
            is_alone = False
        yield is_alone
    finally:
        os.close(file)


@contextlib.contextmanager
def _alone() -> Iterator[None]:
    """Wait until no other experiment removes what was left: both would remove the same things."""
    folder = os.open(tempfile.gettempdir(), os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        fcntl.flock(folder, fcntl.LOCK_EX)
        yield
    finally:
        os.close(folder)


def end_all(find: Callable[[], set[int]]) -> None:
    """Kill processes until none is found.

    Args:
        find: Returns their ids.

    Raises:
        OSError: Some do not end.
    """
    deadline = time.monotonic() + END_S
    while pids := find():
        if time.monotonic() > deadline:
            raise OSError(f"processes of an experiment do not end: {sorted(pids)}")
        for pid in pids:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        time.sleep(0.05)


def family(pid: int) -> list[int]:
    """Return the ids of a process and all of its descendants."""
    found = [pid]
    for one in found:
        for task in Path(f"/proc/{one}/task").glob("*/children"):
            with contextlib.suppress(OSError):  # it has ended meanwhile
                found += map(int, task.read_text().split())
    return found


def command_line(pid: int) -> str:
    """Return a process's command line; empty if it has ended."""
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
    except OSError:
        return ""


def _in_namespaces(names: list[str]) -> Iterator[int]:
    for name in names:
        yield from processes_in(name)


def _in_groups(groups: list[Path]) -> Iterator[int]:
    for group in groups:
        yield from processes_in_group(group)


def _groups() -> Iterator[Path]:
    yield from ROOT.glob("rcx*")
    yield from ROOT.glob("*/rcx*")


def _namespaces() -> list[str]:
    return [one["name"] for one in json.loads(_ip("-j", "netns", "list") or "[]")]


def _interfaces() -> list[str]:
    return [one["ifname"] for one in json.loads(_ip("-j", "link", "show") or "[]")]


def _ip(*words: str) -> str:
    return subprocess.run(["ip", *words], check=False, capture_output=True, text=True).stdout  # noqa: S603, S607
