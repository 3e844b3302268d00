"""How a node's command line and environment are made."""

from __future__ import annotations

import signal
import sys
from pathlib import Path

import pytest

from rce.model.specs import NodeSpec
from rce.ros import system
from rce.ros.packages import PackageIndex
from rce_container.environment.exceptions import NodeError
from rce_container.environment.nodes.launch import NODE_MARK, prepare
from rce_container.environment.nodes.node_life import describe_exit
from rce_container.environment.user_packages import LaunchEnvironment


@pytest.fixture
def packages(tmp_path: Path) -> PackageIndex:
    folder = tmp_path / "with space" / "maps"
    folder.mkdir(parents=True)
    (folder / "package.yaml").write_text("name: maps\n")
    (folder / "serve.py").write_text("")
    return PackageIndex([folder.parent])


def test_arguments_name_and_namespace(packages: PackageIndex) -> None:
    spec = NodeSpec(
        tag="n",
        pkg="maps",
        exe="serve.py",
        args="""'two words' $(find maps)/x.yaml; rm -rf $HOME "a\\"b" """,
        name="server",
        namespace="Robot1",
    )
    launch = prepare(LaunchEnvironment(spec, packages, {"HOME": "/h"}), "mark")
    folder = packages.find("maps").path
    assert launch.argv[:2] == [sys.executable, str(folder / "serve.py")]
    assert launch.argv[2:] == [
        *("two words", f"{folder}/x.yaml;", "rm", "-rf", "$HOME", 'a"b'),
        *("__name:=server", "__ns:=/Robot1"),
    ]
    assert launch.env == {"HOME": "/h", NODE_MARK: "mark", "ROS_NAMESPACE": "/Robot1"}
    assert launch.ros_name == "/Robot1/server"


def test_a_node_may_choose_its_name(packages: PackageIndex) -> None:
    launch = prepare(LaunchEnvironment(NodeSpec(tag="n", pkg="maps", exe="serve.py"), packages, {}), "mark")
    assert launch.ros_name == ""
    assert not any(word.startswith("__") for word in launch.argv)


@pytest.mark.parametrize(
    ("spec", "text"),
    [
        (NodeSpec(tag="n", pkg="nowhere", exe="x"), "no package 'nowhere'"),
        (NodeSpec(tag="n", pkg="maps", exe="missing.py"), "no executable 'missing.py'"),
        (NodeSpec(tag="n", pkg="maps", exe="../../etc/passwd"), "not a file inside"),
        (NodeSpec(tag="n", pkg="maps", exe="serve.py", args="'open"), "quotation"),
        (NodeSpec(tag="n", pkg="maps", exe="serve.py", args="$(env NOT_SET)"), "NOT_SET"),
    ],
)
def test_faults_say_what_is_wrong(packages: PackageIndex, spec: NodeSpec, text: str) -> None:
    with pytest.raises(NodeError, match=text):
        prepare(LaunchEnvironment(spec, packages, {}), "mark")


def test_a_node_of_a_ros_package_gets_the_machines_python(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    engine = str(Path(sys.executable).parent)
    environ = {"PATH": f"{engine}:/usr/bin", "PYTHONPATH": "/engine", "VIRTUAL_ENV": engine, "HOME": "/h"}
    for name, manifest in (("real", "package.xml"), ("maps", "package.yaml")):
        (tmp_path / name / "scripts").mkdir(parents=True)
        (tmp_path / name / manifest).write_text("<package/>" if manifest.endswith("xml") else "")
        (tmp_path / name / "scripts" / "node.py").touch(0o755)
    packages = PackageIndex([tmp_path])
    monkeypatch.setattr(system, "ROS_PREFIXES", tmp_path / "none")
    real = prepare(LaunchEnvironment(NodeSpec(tag="n", pkg="real", exe="node.py"), packages, environ), "mark")
    assert real.argv == [str(tmp_path / "real" / "scripts" / "node.py")]
    assert real.env == {"PATH": "/usr/bin", "HOME": "/h", NODE_MARK: "mark"}
    ours = prepare(LaunchEnvironment(NodeSpec(tag="n", pkg="maps", exe="node.py"), packages, environ), "mark")
    assert ours.env == {**environ, NODE_MARK: "mark"}


def test_a_distribution_in_opt_is_set_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("kinetic", "noetic"):
        (tmp_path / name / "share" / "talker").mkdir(parents=True)
    monkeypatch.setattr(system, "ROS_PREFIXES", tmp_path)
    noetic = tmp_path / "noetic"
    env = system.system_environ({"PATH": "/bin"}, noetic / "share" / "talker")
    assert env["ROS_DISTRO"] == "noetic"
    assert env["PATH"] == f"{noetic}/bin:/bin"
    assert env["PYTHONPATH"] == f"{noetic}/lib/python3/dist-packages"


def test_exits_in_words() -> None:
    assert describe_exit(3) == "exit code 3"
    assert describe_exit(-signal.SIGSEGV) == "killed by SIGSEGV"
    assert "out of memory" in describe_exit(-signal.SIGKILL)


@pytest.mark.parametrize("namespace", ["", "/"])
def test_no_node_takes_the_name_of_the_containers_own(packages: PackageIndex, namespace: str) -> None:
    spec = NodeSpec(tag="n", pkg="maps", exe="serve.py", name="rce_environment", namespace=namespace)
    with pytest.raises(NodeError, match="another name"):
        prepare(LaunchEnvironment(spec, packages, {}), "mark")
    elsewhere = NodeSpec(tag="n", pkg="maps", exe="serve.py", name="rce_environment", namespace="/robot")
    assert prepare(LaunchEnvironment(elsewhere, packages, {}), "mark").ros_name == "/robot/rce_environment"
