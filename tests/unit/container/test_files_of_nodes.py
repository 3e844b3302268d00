"""Folders that nodes filled with whatever they like are measured and removed nevertheless."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from rce_container.environment.logs.files import segments
from rce_container.files import remove, size_of
from rce_container.folder import ContainerFolder

DEPTH = 3000


@pytest.fixture
def deep(tmp_path: Path) -> Path:
    """A folder with folders in one another, deeper than any path can say."""
    root = tmp_path / "root"
    root.mkdir()
    (root / "file").write_bytes(b"12345")
    at = os.open(root, os.O_RDONLY)
    for _ in range(DEPTH):
        os.mkdir("d", dir_fd=at)
        below = os.open("d", os.O_RDONLY, dir_fd=at)
        os.close(at)
        at = below
    os.close(at)
    return root


@pytest.mark.slow
def test_very_deep_trees_are_removed(deep: Path) -> None:
    assert size_of(deep) == 5
    remove(deep)
    assert not deep.exists()
    remove(deep)


@pytest.mark.slow
def test_a_containers_folder_goes_however_deep_it_is(deep: Path, tmp_path: Path) -> None:
    folder = ContainerFolder(tmp_path / "containers", tmp_path / "run", "0" * 12)
    folder.make()
    deep.rename(folder.home / "deep")
    (folder.home / "deep").chmod(0)
    folder.remove()
    assert not folder.path.exists()


def test_sizes_follow_no_links_and_what_is_gone_is_nothing(tmp_path: Path) -> None:
    (tmp_path / "a" / "b").mkdir(parents=True)
    (tmp_path / "a" / "b" / "file").write_bytes(b"123")
    (tmp_path / "a" / "loop").symlink_to(tmp_path)
    link = len(str(tmp_path))
    assert size_of(tmp_path / "a") == 3 + link
    assert size_of(tmp_path / "none") == 0


def test_segments_are_files_with_plain_numbers(tmp_path: Path) -> None:
    for name in ("n.000000000005.log", "n.\u00b2\u00b2.log", "n.-1.log", "n..log", "n.x.log"):
        (tmp_path / name).touch()
    assert segments(tmp_path, "n") == [(5, tmp_path / "n.000000000005.log")]
