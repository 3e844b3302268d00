"""Packages' folders: what goes in, what keeps one from being packed, and that equal ones are equal."""

from __future__ import annotations

import io
import os
import socket
from pathlib import Path

import pytest

from rce.config.folders import examples_dir
from rce.packages.exceptions import BadArchiveError
from rce.packages.folder import look_into
from rce.packages.limits import ArchiveLimits


@pytest.fixture
def package(tmp_path: Path) -> Path:
    folder = tmp_path / "nav"
    (folder / "nodes").mkdir(parents=True)
    (folder / "package.yaml").write_text("name: nav\nversion: '1.2.0'\n")
    (folder / "nodes" / "run.py").write_text("print('hi')\n")
    return folder


def packed(folder: Path, version: str = "") -> bytes:
    archive = io.BytesIO()
    look_into(folder, version).pack(archive)
    return archive.getvalue()


def inside(folder: Path, version: str = "") -> list[str]:
    return ["/".join(entry.parts[1:]) for entry in look_into(folder, version).tree.entries.values()][1:]


def fault(folder: Path, version: str = "", limits: ArchiveLimits | None = None) -> str:
    with pytest.raises(BadArchiveError) as caught:
        look_into(folder, version, *([limits] if limits else []))
    return str(caught.value)


def test_equal_folders_make_equal_archives(package: Path, tmp_path: Path) -> None:
    first = packed(package)
    other = tmp_path / "elsewhere" / "nav"
    other.mkdir(parents=True)
    for name in ("nodes", "package.yaml"):  # made in another order, at another time
        if name == "nodes":
            (other / name).mkdir(mode=0o700)
            (other / "nodes" / "run.py").write_text("print('hi')\n")
        else:
            (other / name).write_text((package / name).read_text())
    os.utime(other / "nodes" / "run.py", (1, 1))
    (other / "package.yaml").chmod(0o600)
    assert packed(other) == first
    (other / "nodes" / "run.py").chmod(0o755)
    assert packed(other) != first


def test_what_is_told_of_a_package(package: Path) -> None:
    (package / "nodes" / "tool").write_text("#!/bin/sh\n")
    (package / "nodes" / "tool").chmod(0o755)
    (package / "requirements.txt").write_text("six\n")
    source = look_into(package)
    assert (source.contents.name, source.version) == ("nav", "1.2.0")
    assert source.contents.executables == ("run.py", "tool")
    assert source.contents.requirements
    assert source.contents.warnings == ()
    assert look_into(package, "2.0-rc1").version == "2.0-rc1"


def test_a_ros_package_is_one_too(tmp_path: Path) -> None:
    folder = tmp_path / "old"
    (folder / "scripts").mkdir(parents=True)
    (folder / "package.xml").write_text("<package><name>old</name><version>0.3.1</version></package>")
    (folder / "scripts" / "node.py").write_text("#!/usr/bin/env python3\n")
    source = look_into(folder)
    assert source.version == "0.3.1"
    assert "scripts/node.py may not be executed" in " ".join(source.contents.warnings)


def test_the_shipped_example_can_be_pushed() -> None:
    source = look_into(examples_dir() / "Test", "1.0")
    assert source.contents.executables == ("counter.py", "paramTest.py", "stringEcho.py")
    assert not any("__pycache__" in path for path in source.tree.entries)


def test_some_things_stay_at_home(package: Path) -> None:
    for path in (".git/config", "nodes/__pycache__/run.cpython-311.pyc", "maps/a.bag", "maps/b.png", "a.bag"):
        (package / path).parent.mkdir(parents=True, exist_ok=True)
        (package / path).write_text("x")
    for path in ("data/raw.txt", "nodes/data", "build/out", "nodes/build"):
        (package / path).parent.mkdir(parents=True, exist_ok=True)
        (package / path).write_text("x")
    (package / ".rceignore").write_text("# what is large\n*.bag\n/data\nmaps/*.png\nbuild/\n\n")
    assert inside(package) == ["maps", "nodes", "nodes/build", "nodes/data", "nodes/run.py", "package.yaml"]
    (package / ".rceignore").write_text("!keep\n**/x\n")
    assert "line 1" in fault(package)
    assert "line 2" in fault(package)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("manifest", "text"),
    [
        (None, "it has no package.yaml or package.xml"),
        ("name: 9nav\nversion: '1.0'\n", "is not a package name"),
        ("name: my-nav\nversion: '1.0'\n", "cannot be named by a node"),
        ("name: nav\n", "the package has no version"),
        ("name: nav\nversion: 1.10\n", "in quotes"),
        ("name: nav\nversion: 'one'\n", "is not a version"),
        ("name: nav\nversion: '1.0.'\n", "is not a version"),
        ("name: nav\nversion: '../1'\n", "is not a version"),
        ("- nav\n", "key: value"),
        ("name: [nav\n", "package.yaml"),
        ("a: " + "[" * 2000 + "]" * 2000, "package.yaml"),
        ("x" * 100_000, "bytes"),
    ],
)
def test_a_wrong_manifest_is_told(package: Path, manifest: str | None, text: str) -> None:
    if manifest is None:
        (package / "package.yaml").unlink()
    else:
        (package / "package.yaml").write_text(manifest)
    assert text in fault(package)


def test_all_that_cannot_be_packed_is_told_at_once(package: Path, tmp_path: Path) -> None:
    (tmp_path / "secret").write_text("x")
    for name, target in (
        ("out", "../secret"),
        ("absolute", "/etc/passwd"),
        ("nowhere", "missing"),
        ("loop", "loop"),
        ("through", "good/../../secret"),
    ):
        (package / name).symlink_to(target)
    (package / "good").symlink_to("nodes/run.py")
    (package / "also").symlink_to("good")
    told = fault(package)
    for name in ("out", "absolute", "nowhere", "loop", "through"):
        assert f"nav/{name}" in told
    assert "'nav/good': " not in told
    assert "'nav/also': " not in told


def test_sockets_pipes_and_odd_names_are_refused(package: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(package)
    with socket.socket(socket.AF_UNIX) as sock:
        sock.bind("door")
    os.mkfifo(package / "pipe")
    (package / "line\nbreak").write_text("")
    (package / ("d" * 200)).mkdir()
    (package / ("d" * 200) / "file").write_text("")
    os.close(os.open(os.fsencode(package) + b"/\xff", os.O_CREAT | os.O_WRONLY))
    told = fault(package)
    assert "'door': it is a socket" in told
    assert "'pipe': it is a pipe" in told
    assert told.count("cannot be printed") == 2
    assert "too long" in told


def test_too_much_is_refused(package: Path) -> None:
    (package / "large").write_bytes(bytes(5000))
    assert "more than 4000 bytes" in fault(package, limits=ArchiveLimits(unpacked=4000))
    assert "more than 3 files" in fault(package, limits=ArchiveLimits(entries=3))
    deep = package / "a" / "b" / "c"
    deep.mkdir(parents=True)
    assert "folders deep" in fault(package, limits=ArchiveLimits(depth=3))


def test_what_no_node_can_name_is_told(package: Path) -> None:
    (package / "nodes" / "run.py").rename(package / "run.txt")
    assert "no node can be made of it" in " ".join(look_into(package).contents.warnings)
    (package / "msg").mkdir()
    assert look_into(package).contents.warnings == ()


def test_a_file_that_changes_while_it_is_packed_is_noticed(package: Path) -> None:
    source = look_into(package)
    (package / "nodes" / "run.py").write_text("print('changed')\n")
    with pytest.raises(BadArchiveError, match="changed while it was read"):
        source.pack(io.BytesIO())
