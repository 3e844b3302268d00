"""Copies of volumes on file systems that share blocks between files (btrfs, XFS)."""

from __future__ import annotations

import fcntl
import os
from pathlib import Path

import pytest

from rce_container.volumes import tree
from rce_container.volumes.tree import Allowance


@pytest.fixture
def is_sharing(monkeypatch: pytest.MonkeyPatch) -> None:
    """``FICLONE`` works: it puts a file's bytes into another one, and never shortens that."""

    def clone(target: int, request: int, source: int) -> int:
        assert request == tree._CLONE
        os.pwrite(target, os.pread(source, os.fstat(source).st_size, 0), 0)
        return 0

    monkeypatch.setattr(fcntl, "ioctl", clone)


def copy(source: Path, target: Path) -> None:
    ends = [os.open(path, os.O_RDONLY | os.O_DIRECTORY) for path in (source, target)]
    try:
        tree.finish_copy(tree.copy(ends[0], ends[1], Allowance(1 << 20)), ends[1])
    finally:
        for end in ends:
            os.close(end)


@pytest.mark.usefixtures("is_sharing")
@pytest.mark.parametrize("size", [0, 4096, 30_000])
def test_a_copy_follows_a_changed_length(tmp_path: Path, size: int) -> None:
    source, target = tmp_path / "source", tmp_path / "target"
    source.mkdir()
    target.mkdir()
    (source / "file").write_bytes(os.urandom(10_000))
    copy(source, target)
    (source / "file").write_bytes(os.urandom(size))
    copy(source, target)
    assert (target / "file").read_bytes() == (source / "file").read_bytes()
