"""Executables at any depth of a package's folder, found as rosrun finds them."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import pytest

from rce.ros import executables
from rce.ros.executables import ExecutableFinder


def write(file: Path, mode: int = 0o755) -> Path:
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text("#!/bin/sh\n")
    file.chmod(mode)
    return file


def test_nearest_file_counts_then_the_first_by_the_alphabet(tmp_path: Path) -> None:
    finder = ExecutableFinder()
    write(tmp_path / "a" / "b" / "node")
    second = write(tmp_path / "z" / "node")
    assert finder.find(tmp_path, "node") == second
    first = write(tmp_path / "y" / "node")
    assert finder.find(tmp_path, "node") == first


def test_hidden_folders_and_files_without_the_right_are_left_out(tmp_path: Path) -> None:
    finder = ExecutableFinder()
    write(tmp_path / ".git" / "node")
    write(tmp_path / "a" / "node", 0o644)
    (tmp_path / "b" / "node").mkdir(parents=True)
    assert finder.find(tmp_path, "node") is None
    found = write(tmp_path / "c" / "d" / "node")
    assert finder.find(tmp_path, "node") == found


def test_links_are_followed_and_loops_end(tmp_path: Path) -> None:
    folder, elsewhere = tmp_path / "pkg", tmp_path / "elsewhere"
    folder.mkdir()
    write(elsewhere / "deep" / "node")
    (folder / "link").symlink_to(elsewhere)
    (folder / "loop").symlink_to(folder)
    assert ExecutableFinder().find(folder, "node") == folder / "link" / "deep" / "node"


def test_result_is_remembered_until_a_folder_changes(tmp_path: Path) -> None:
    finder = ExecutableFinder()
    file = write(tmp_path / "src" / "tools" / "node")
    for _ in range(5):
        assert finder.find(tmp_path, "node") == file
    assert finder.searches == 1
    file.unlink()
    assert finder.find(tmp_path, "node") is None
    assert finder.searches == 2


def test_search_of_a_huge_folder_ends(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(executables, "MAX_FOLDERS", 10)
    write(tmp_path / "z" / "z" / "node")
    for number in range(20):
        (tmp_path / f"f{number}").mkdir()
    assert ExecutableFinder().find(tmp_path, "node") is None


@pytest.mark.slow
@pytest.mark.needs("roslaunch")
@pytest.mark.parametrize("place", ["cfg", "src/pkg/tools", "launch/.hidden", "lib/pkg"])
def test_same_files_are_found_as_by_roslaunch(tmp_path: Path, place: str) -> None:
    package = tmp_path / "pkg"
    file = write(package / place / "node")
    (package / "package.xml").write_text(
        "<package><name>pkg</name><version>1.0.0</version><description>x</description>"
        "<maintainer email='a@b.c'>x</maintainer><license>x</license></package>"
    )
    code = "import roslib.packages; print(*roslib.packages.find_node('pkg', 'node'), sep=',')"
    env = {key: value for key, value in os.environ.items() if not key.startswith(("PYTHON", "ROS_"))}
    env["ROS_PACKAGE_PATH"] = str(tmp_path)
    ran = subprocess.run(
        ["/usr/bin/python3", "-c", code], env=env, capture_output=True, text=True, check=True, timeout=100
    )
    found = ExecutableFinder().find(package, "node")
    assert ("" if found is None else str(found)) == ran.stdout.strip()
    assert (found == file) == (".hidden" not in place)
