"""Packages on a path, their executables, and what is substituted in arguments."""

import json
import os
import subprocess
import sys
import xml
from collections.abc import Iterator
from importlib.metadata import EntryPoint, EntryPoints
from pathlib import Path
from typing import Protocol

import pytest

from rce.ros import entry_points
from rce.ros.errors import BadPackageError, ExecutableNotFoundError, PackageNotFoundError
from rce.ros.packages import PackageIndex
from rce.ros.substitution import SubstitutionError, split_arguments, substitute


def make(folder: Path, manifest: str = "package.yaml", text: str = "", **files: int) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / manifest).write_text(text)
    for name, mode in files.items():
        file = folder / name.replace("__", "/").replace("_py", ".py")
        file.parent.mkdir(exist_ok=True)
        file.write_text("#!/bin/sh\n")
        file.chmod(mode)
    return folder


def test_package_is_found_by_folder_and_declared_name(tmp_path: Path) -> None:
    """A package is found by folder by itself and by declared name."""
    one = make(tmp_path / "one", text="description: first\n")
    two = make(tmp_path / "folder", text="name: two\n")
    three = make(tmp_path / "three", "package.xml", "<package><name>three</name></package>")
    index = PackageIndex([tmp_path])
    assert index.find("one").path == one
    assert index.find("one").description == "first"
    assert index.find("two").path == two
    assert index.find("three").path == three
    assert PackageIndex([two]).find("two").path == two
    assert PackageIndex([one]).find("one").path == one
    for name in ("folder", "four", "../one", ""):
        with pytest.raises(PackageNotFoundError, match=str(tmp_path)):
            index.find(name)


def test_the_first_hit_on_the_path_counts(tmp_path: Path) -> None:
    first = make(tmp_path / "a" / "pkg")
    make(tmp_path / "b" / "pkg")
    assert PackageIndex([tmp_path / "missing", tmp_path / "a", tmp_path / "b"]).find("pkg").path == first


def test_the_path_comes_from_the_environment(tmp_path: Path) -> None:
    path = PackageIndex.from_environ({"RCE_PACKAGE_PATH": f"/a{os.pathsep}/b", "ROS_PACKAGE_PATH": "/c"}).path
    assert [str(folder) for folder in path] == ["/a", "/b", "/c"]
    assert PackageIndex.from_environ({}).path == ()


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("python: two\n", "python is 'two'"),
        ("- list\n", "'key: value' lines"),
        ("name: [\n", "package.yaml"),
        ("name: 'a b'\n", "not a package name"),
    ],
)
def test_a_bad_manifest_is_told(tmp_path: Path, text: str, part: str) -> None:
    make(tmp_path / "pkg", text=text)
    with pytest.raises(BadPackageError, match=part):
        PackageIndex([tmp_path]).find("pkg")


def test_executables_are_found_in_the_usual_folders(tmp_path: Path) -> None:
    folder = make(
        tmp_path / "pkg",
        root=0o755,
        nodes__node=0o755,
        scripts__script=0o755,
        bin__tool=0o755,
        lib__helper=0o755,
    )
    package = PackageIndex([tmp_path]).find("pkg")
    for exe, file in (
        ("root", "root"),
        ("node", "nodes/node"),
        ("script", "scripts/script"),
        ("tool", "bin/tool"),
        ("helper", "lib/helper"),
        ("nodes/node", "nodes/node"),
    ):
        assert package.executable(exe) == [str(folder / file)]


def test_python_files_run_with_the_engine_or_by_their_first_line(tmp_path: Path) -> None:
    ours = make(tmp_path / "ours", nodes__n_py=0o644)
    make(tmp_path / "system", text="python: system\n", nodes__n_py=0o755)
    make(tmp_path / "ros", "package.xml", "<package><name>ros</name></package>", scripts__n_py=0o755)
    index = PackageIndex([tmp_path])
    assert index.find("ours").executable("n.py") == [sys.executable, str(ours / "nodes" / "n.py")]
    assert index.find("system").executable("n.py") == [str(tmp_path / "system" / "nodes" / "n.py")]
    assert index.find("ros").executable("n.py") == [str(tmp_path / "ros" / "scripts" / "n.py")]


@pytest.mark.parametrize(
    "exe", ["../outside", "nodes/../../outside", "/bin/sh", "", "missing", "nodes", "a\0b"]
)
def test_what_is_not_inside_the_package_is_refused(tmp_path: Path, exe: str) -> None:
    make(tmp_path / "pkg", nodes__n=0o755)
    (tmp_path / "outside").write_text("#!/bin/sh\n")
    (tmp_path / "outside").chmod(0o755)
    with pytest.raises(ExecutableNotFoundError):
        PackageIndex([tmp_path]).find("pkg").executable(exe)


def test_executable_elsewhere_wins_over_plain_file(tmp_path: Path) -> None:
    """File elsewhere that may be executed goes before one that may not."""
    folder = make(tmp_path / "pkg", "package.xml", "<package><name>pkg</name></package>", nodes__n=0o644)
    file = folder / "test" / "tools" / "n"
    file.parent.mkdir(parents=True)
    file.write_text("#!/bin/sh\n")
    file.chmod(0o755)
    assert PackageIndex([tmp_path]).find("pkg").executable("n") == [str(folder / "test" / "tools" / "n")]


def test_a_file_that_may_not_be_executed_is_refused(tmp_path: Path) -> None:
    make(tmp_path / "pkg", nodes__n=0o644)
    with pytest.raises(ExecutableNotFoundError, match="chmod"):
        PackageIndex([tmp_path]).find("pkg").executable("n")


def test_installed_packages_have_programs_in_lib(tmp_path: Path) -> None:
    share, programs = tmp_path / "share", tmp_path / "lib" / "tools"
    make(programs, manifest="relay", text="#!/bin/sh\n")
    (programs / "relay").chmod(0o755)
    index = PackageIndex([share])
    assert index.find("tools").executable("relay") == [str(programs / "relay")]
    (share / "tools" / "msg").mkdir(parents=True)
    assert index.find("tools").path == share / "tools"
    assert index.find("tools").executable("relay") == [str(programs / "relay")]


class Distributed(Protocol):
    """Sets entry points: group, name, value; see :func:`distributed`."""

    def __call__(self, *points: tuple[str, str, str]) -> None: ...


@pytest.fixture
def distributed(monkeypatch: pytest.MonkeyPatch) -> Iterator[Distributed]:
    """Lets installed distributions have the entry points that a test gives."""

    def forget() -> None:
        entry_points.distributed_packages.cache_clear()
        entry_points.distributed_nodes.cache_clear()

    def have(*points: tuple[str, str, str]) -> None:
        found = EntryPoints(EntryPoint(name, value, group) for group, name, value in points)
        monkeypatch.setattr("importlib.metadata.entry_points", found.select)
        forget()

    yield have
    forget()


def test_distributions_add_nodes_that_are_functions(distributed: Distributed) -> None:
    distributed(("rce.nodes", "Clock:now.py", "time:time_ns"))
    with pytest.raises(
        BadPackageError, match="no file of a module time"
    ):  # `time` is built in and has no folder
        PackageIndex([]).find("Clock")
    distributed(("rce.nodes", "Json:tool", "json.tool:main"))
    argv = PackageIndex([]).find("Json").executable("tool")
    done = subprocess.run(argv, input='{"a": 1}', capture_output=True, text=True, check=True)
    assert done.stdout == '{\n    "a": 1\n}\n'


def test_distributions_add_packages_with_nodes_that_are_scripts(distributed: Distributed) -> None:
    distributed(
        ("rce.packages", "shop", "xml"),
        ("rce.nodes", "shop:tool.py", "json.tool"),
        ("rce.packages", "bad", "no.x"),
    )
    found = PackageIndex([]).find("shop")
    assert found.path == Path(xml.__file__).parent
    script = Path(json.__file__).parent / "tool.py"
    assert found.executable("tool.py") == [sys.executable, str(script)]
    with pytest.raises(BadPackageError, match=r"entry point no\.x"):
        PackageIndex([]).find("bad")


def test_packages_on_the_path_go_before_those_of_distributions(
    distributed: Distributed, tmp_path: Path
) -> None:
    distributed(("rce.packages", "shop", "json"))
    folder = make(tmp_path / "shop")
    assert PackageIndex([tmp_path]).find("shop").path == folder


def test_a_real_package_goes_before_a_distributed_node(distributed: Distributed, tmp_path: Path) -> None:
    distributed(("rce.nodes", "shop:tool", "json.tool"), ("rce.nodes", "shop:till", "json.tool"))
    ours = PackageIndex([]).find("shop").program("tool")
    script = Path(json.__file__).parent / "tool.py"
    assert (ours.command, ours.package.python) == ([sys.executable, str(script)], "engine")
    assert (ours.choice, ours.target) == ("shop/tool is json.tool", "json.tool")
    folder = make(tmp_path / "shop", manifest="package.xml", text="<package/>", nodes__tool=0o755)
    real = PackageIndex([tmp_path]).find("shop")
    file = folder / "nodes" / "tool"
    assert real.program("tool") == ([str(file)], real, f"shop/tool is {file}, not json.tool", "")
    till = real.program("till")
    assert (till.command, till.package.python) == ([sys.executable, str(script)], "engine")
    assert till.choice == f"shop/till is json.tool; the package in {folder} does not have it"


def test_the_fleet_is_such_a_package() -> None:
    found = PackageIndex([]).find("fleet")
    assert [Path(found.executable(exe)[-1]).name for exe in ("fleet_planner.py", "move_client.py")] == [
        "fleet_planner.py",
        "move_client.py",
    ]
    assert (found.path / "msg" / "FleetState.msg").is_file()


def test_find_and_env_are_substituted(tmp_path: Path) -> None:
    folder = make(tmp_path / "pkg")
    index = PackageIndex([tmp_path])
    text = substitute("a $(find pkg)/x $(env HOME)$ $HOME `id`", index, {"HOME": "$(find pkg)"})
    assert text == f"a {folder}/x $(find pkg)$ $HOME `id`"


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("$(find nothing)", "no package 'nothing'"),
        ("$(env NOTHING)", "no environment variable NOTHING"),
        ("$(rm -rf /)", "is not known"),
        ("$(find a b)", "is not known"),
        ("$()", "is not known"),
        ("x $(find pkg", "without ')'"),
        ("'open", "no closing quotation"),
        ("a\0b", "NUL"),
    ],
)
def test_a_bad_substitution_is_told(tmp_path: Path, text: str, part: str) -> None:
    make(tmp_path / "pkg")
    with pytest.raises(SubstitutionError) as caught:
        split_arguments(text, PackageIndex([tmp_path]), {})
    assert part in str(caught.value)


def test_arguments_split_like_a_shell_values_stay_whole(tmp_path: Path) -> None:
    """Arguments are split as a shell splits and values stay in their word."""
    folder = make(tmp_path / "pkg")
    words = split_arguments(
        """a "b c" 'd e' f\\ g $(env X) "$(find pkg)/m.yaml" x:=$(env X); ls""",
        PackageIndex([tmp_path]),
        {"X": "two words' \"; rm -rf /"},
    )
    value = "two words' \"; rm -rf /"
    assert words == ["a", "b c", "d e", "f g", value, f"{folder}/m.yaml", f"x:={value};", "ls"]


def test_a_folder_that_may_not_be_entered_spoils_no_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    closed, one = tmp_path / "closed", make(tmp_path / "open" / "one")
    closed.mkdir()

    def stat(path: str | Path, **how: bool) -> os.stat_result:
        if Path(path).is_relative_to(closed) and Path(path) != closed:
            raise PermissionError(13, "Permission denied", str(path))
        return original(path, **how)

    original = os.stat
    monkeypatch.setattr(os, "stat", stat)
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path) != closed)
    index = PackageIndex([closed, tmp_path / "open"])
    assert index.find("one").path == one
    with pytest.raises(PackageNotFoundError, match=f"{closed} may not be read here"):
        index.find("two")
