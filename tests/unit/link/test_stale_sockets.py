"""Socket files of processes that were killed."""

from __future__ import annotations

import os
import socket
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from rce.link.unix import remove_stale_sockets, socket_name


@pytest.fixture
def folder() -> Iterator[Path]:
    with tempfile.TemporaryDirectory(dir="/tmp") as name:
        yield Path(name)


def bound(path: Path, *, listens: bool, old: bool = True) -> socket.socket:
    sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    sock.bind(str(path))
    if listens:
        sock.listen()
    if old:
        os.utime(path, (0, 0))
    return sock


def test_only_what_nobody_can_want_any_more_is_removed(folder: Path) -> None:
    for name, listens, old in (("a_dead", False, True), ("a_new", False, False), ("b_dead", False, True)):
        bound(folder / name, listens=listens, old=old).close()
    (folder / "a_file").write_text("")
    os.utime(folder / "a_file", (0, 0))
    with bound(folder / "a_alive", listens=True):
        remove_stale_sockets(folder, "a_*")
        assert sorted(path.name for path in folder.iterdir()) == ["a_alive", "a_file", "a_new", "b_dead"]


def test_a_young_socket_of_a_process_that_ended_is_removed(folder: Path) -> None:
    ended = subprocess.Popen(["true"])
    ended.wait()
    for name in (f"a_1.{ended.pid}.sock", socket_name("a_2")):
        bound(folder / name, listens=False, old=False).close()
    remove_stale_sockets(folder, "a_*")
    assert [path.name for path in folder.iterdir()] == [f"a_2.{os.getpid()}.sock"]
