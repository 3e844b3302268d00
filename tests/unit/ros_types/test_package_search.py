"""Packages are searched for in depth, as rospack and rospkg do; searches are remembered."""

from __future__ import annotations

import json
import logging
import os
import random
import subprocess
import threading
import time
from pathlib import Path

import pytest

from rce.ros import package_tree
from rce.ros.errors import PackageNotFoundError
from rce.ros.package_tree import PackageTree
from rce.ros.packages import PackageIndex

LIST = """
import json, sys, rospkg
found = {}
for root in json.load(sys.stdin):
    rospack = rospkg.RosPack([root])
    found[root] = {name: rospack.get_path(name) for name in rospack.list()}
print(json.dumps(found))
"""


def package(folder: Path, name: str = "", manifest: str = "package.xml") -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    text = f"<package><name>{name or folder.name}</name></package>"
    (folder / manifest).write_text(text if manifest == "package.xml" else "<package/>")
    return folder


def found_in(root: Path) -> dict[str, Path]:
    return tree(root).packages()


def tree(root: Path) -> PackageTree:
    return PackageTree(root, ("package.yaml", "package.xml", "manifest.xml"), _name_of)


def _name_of(folder: Path) -> str:
    file = folder / "package.xml"
    return file.read_text().split("<name>")[1].split("<")[0] if file.exists() else folder.name


def test_packages_of_a_workspace_are_found_in_depth(tmp_path: Path) -> None:
    """``src/repository/package`` is how catkin workspaces are made."""
    deep = package(tmp_path / "src" / "repository" / "deep")
    flat = package(tmp_path / "src" / "flat")
    old = package(tmp_path / "src" / "stack" / "old", manifest="manifest.xml")
    index = PackageIndex([tmp_path / "src"])
    assert [index.find(name).path for name in ("deep", "flat", "old")] == [deep, flat, old]
    assert PackageIndex([tmp_path]).find("deep").path == deep


def test_a_users_folder_named_share_is_searched_in_depth(tmp_path: Path) -> None:
    """Only that of a distribution, with ``lib`` beside it, has its packages at the first level."""
    deep = package(tmp_path / "share" / "repository" / "deep")
    index = PackageIndex([tmp_path / "share"])
    assert index.find("deep").path == deep
    (tmp_path / "lib").mkdir()
    with pytest.raises(PackageNotFoundError):
        PackageIndex([tmp_path / "share"]).find("deep")


def test_the_search_stops_at_a_package(tmp_path: Path) -> None:
    outer = package(tmp_path / "outer")
    package(outer / "inner")
    assert found_in(tmp_path) == {"outer": outer}
    assert found_in(outer) == {"outer": outer}


@pytest.mark.parametrize("mark", [*package_tree.IGNORE_MARKS, package_tree.NO_SUBFOLDERS])
def test_marked_folders_are_left_out(tmp_path: Path, mark: str) -> None:
    package(tmp_path / "marked" / "hidden")
    (tmp_path / "marked" / mark).touch()
    kept = package(tmp_path / "kept")
    assert found_in(tmp_path) == {"kept": kept}


@pytest.mark.parametrize("mark", package_tree.IGNORE_MARKS)
def test_a_marked_package_is_left_out(tmp_path: Path, mark: str) -> None:
    (package(tmp_path / "a" / "one") / mark).touch()
    assert found_in(tmp_path) == {}


def test_hidden_folders_are_left_out_but_not_a_hidden_root(tmp_path: Path) -> None:
    package(tmp_path / ".git" / "one")
    two = package(tmp_path / ".hidden" / "two")
    assert found_in(tmp_path) == {}
    assert found_in(tmp_path / ".hidden") == {"two": two}


def test_the_path_goes_first_then_depth_then_the_alphabet(tmp_path: Path) -> None:
    package(tmp_path / "one" / "a" / "deeper" / "p")
    package(tmp_path / "one" / "b" / "p")
    shallow = package(tmp_path / "one" / "a" / "p")
    other = package(tmp_path / "two" / "z", "p")
    assert PackageIndex([tmp_path / "one", tmp_path / "two"]).find("p").path == shallow
    assert PackageIndex([tmp_path / "two", tmp_path / "one"]).find("p").path == other


def test_loops_of_links_end_and_each_folder_is_searched_once(tmp_path: Path) -> None:
    real = package(tmp_path / "elsewhere" / "linked")
    root = tmp_path / "root"
    package(root / "a" / "p")
    (root / "a" / "up").symlink_to(root)
    (root / "self").symlink_to(root / "self")
    (root / "b").symlink_to(tmp_path / "elsewhere")
    for number in range(20):  # without a memory, 2 ** 20 paths
        level = root / "c" / f"{number}"
        level.mkdir(parents=True)
        for side in "lr":
            (level / side).symlink_to(root / "c" / f"{number + 1}")
    found = found_in(root)
    assert found.keys() == {"p", "linked"}
    assert found["linked"].resolve() == real


def test_only_changed_packages_are_searched_again(tmp_path: Path) -> None:
    """What changes is noticed and nothing else is searched again."""
    a = package(tmp_path / "x" / "a")
    searched = tree(tmp_path)
    for _ in range(3):
        assert searched.packages() == {"a": a}
    assert searched.searches == 1
    b = package(tmp_path / "x" / "y" / "b")
    assert searched.packages() == {"a": a, "b": b}
    package(a, "renamed")
    assert searched.packages() == {"renamed": a, "b": b}
    (tmp_path / "x" / "y" / "CATKIN_IGNORE").touch()
    assert searched.packages() == {"renamed": a}
    (a / "package.xml").unlink()
    assert searched.packages() == {}
    assert searched.searches == 5


def test_a_package_that_is_added_after_a_miss_is_found(tmp_path: Path) -> None:
    index = PackageIndex([tmp_path / "later"])
    with pytest.raises(PackageNotFoundError):
        index.find("p")
    added = package(tmp_path / "later" / "repository" / "p")
    assert index.find("p").path == added


@pytest.mark.slow
def test_a_large_tree_is_looked_at_seldom(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ten thousand lookups cost one search and few checks, by a clock that only the checks move."""
    for number in range(package_tree.SMALL + 1):
        (tmp_path / f"{number}").mkdir()
    clock = [0.0]

    def now() -> float:
        clock[0] += 0.001
        return clock[0]

    monkeypatch.setattr(time, "monotonic", now)
    searched = tree(tmp_path)
    for _ in range(10_000):
        searched.packages()
    assert searched.searches == 1
    assert searched.checks <= 10_000 / package_tree.CHECK_SHARE


@pytest.fixture
def large(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder that counts as large, and whose checks are good for long."""
    monkeypatch.setattr(package_tree, "SMALL", 1)
    monkeypatch.setattr(package_tree, "CHECK_SHARE", 1e9)
    package(tmp_path / "large" / "src" / "a")
    return tmp_path / "large"


def test_a_look_up_after_a_search_does_not_look_again(large: Path) -> None:
    """Also not for changes: it may be in an event loop, where the search was in a thread."""
    searched = tree(large)
    was_slow = searched.is_slow
    searched.packages()
    assert (was_slow, searched.is_slow) == (True, False)
    looked = searched.searches, searched.checks
    searched.packages()
    assert (searched.searches, searched.checks) == looked


def test_a_small_folder_is_searched_once_and_is_never_slow(tmp_path: Path) -> None:
    searched = tree(tmp_path)
    searched.packages()
    assert (searched.searches, searched.checks, searched.is_slow) == (1, 0, False)


def test_what_another_user_found_is_checked_before_it_is_used(large: Path) -> None:
    index = PackageIndex([large])
    index.look()
    moved = package(large / "src" / "b")
    with pytest.raises(PackageNotFoundError):
        index.find("b")
    index.expire()
    assert index.find("b").path == moved


async def test_only_slow_searches_are_made_in_a_thread(large: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    threads: list[bool] = []
    look = PackageTree.packages

    def packages(self: PackageTree) -> dict[str, Path]:
        threads.append(threading.current_thread() is threading.main_thread())
        return look(self)

    monkeypatch.setattr(PackageTree, "packages", packages)
    index = PackageIndex([large, large / "absent"])
    await index.look_ahead()
    assert threads == [False, False]
    await index.look_ahead()
    assert threads == [False, False], "nothing to do"
    assert index.find("a").path == large / "src" / "a"
    index.expire()
    await index.look_ahead()
    assert threads[3:] == [False, False]


def test_a_whole_disk_is_not_searched(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(package_tree, "MAX_FOLDERS", 10)
    for number in range(20):
        package(tmp_path / "many" / f"{number}" / "p")
    first = package(tmp_path / "first")
    with caplog.at_level(logging.WARNING):
        assert found_in(tmp_path) == {"first": first}
    assert "more than 10 folders" in caplog.text


@pytest.mark.slow
@pytest.mark.needs("rospy")
def test_the_same_packages_are_found_as_by_rospkg(tmp_path: Path) -> None:
    """Of random trees; rospkg knows neither links that loop nor the marks of ROS 2's tools."""
    random_trees = random.Random(8)
    roots = [tmp_path / f"tree{number}" for number in range(150)]
    for root in roots:
        grow(root, random_trees)
    listed = subprocess.run(
        ["/usr/bin/python3", "-c", LIST],
        input=json.dumps([str(root) for root in roots]),
        capture_output=True,
        text=True,
        check=True,
        env={"PATH": "/usr/bin:/bin", "HOME": str(tmp_path)},
    )
    expected: dict[str, dict[str, str]] = json.loads(listed.stdout)
    assert sum(map(len, expected.values())) > 150
    for root in roots:
        ours = {name: os.path.realpath(path) for name, path in found_in(root).items()}
        theirs = {name: os.path.realpath(path) for name, path in expected[str(root)].items()}
        assert ours == theirs, root


def grow(folder: Path, chance: random.Random, depth: int = 0) -> None:
    """Make a random tree; all names in it are different."""
    folder.mkdir()
    draw = chance.random()
    if depth and draw < 0.25:
        package(folder, f"p{chance.getrandbits(60)}", chance.choice(["package.xml", "manifest.xml"]))
    if chance.random() < 0.08:
        (folder / chance.choice(["CATKIN_IGNORE", "rospack_nosubdirs"])).touch()
    if chance.random() < 0.3:
        (folder / "README.md").touch()
    if depth < 5:
        for number in range(chance.randrange(4)):
            hidden = "." if number == 0 and chance.random() < 0.2 else ""  # of two, rospkg leaves out one
            grow(folder / f"{hidden}f{chance.getrandbits(60)}", chance, depth + 1)
    if depth == 1 and chance.random() < 0.3:
        (folder / f"l{chance.getrandbits(60)}").symlink_to(
            package(folder.parent.parent / f"away{chance.getrandbits(60)}")
        )
