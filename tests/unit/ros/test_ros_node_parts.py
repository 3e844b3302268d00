"""Parts of a node that need no socket: settings and queues."""

from __future__ import annotations

from pathlib import Path

from rce.ros.names import is_base_name
from rce.ros.node.settings import NodeSettings, anonymous_name, parse_value


def gather(
    argv: tuple[str, ...] = (), environ: dict[str, str] | None = None, namespace: str = ""
) -> NodeSettings:
    return NodeSettings.gather("node", namespace=namespace, argv=argv, environ=environ or {})


async def test_defaults() -> None:
    settings = await gather().placed()
    assert settings.master_uri == "http://127.0.0.1:11311/"
    assert settings.resolver.node_name == "/node"
    assert (settings.host, settings.bind) == ("127.0.0.1", "127.0.0.1")


def test_command_line_wins_over_program_and_environment() -> None:
    """The command line wins over the program and the environment."""
    environ = {"ROS_NAMESPACE": "env", "ROS_MASTER_URI": "http://10.0.0.9:1/", "ROS_IP": "10.0.0.2"}
    assert gather(environ=environ).resolver.node_name == "/env/node"
    assert gather(environ=environ, namespace="own").resolver.node_name == "/own/node"
    settings = gather(
        ("__ns:=arg", "__name:=other", "__master:=http://10.0.0.8:2/", "__ip:=10.0.0.3"), environ, "own"
    )
    assert settings.resolver.node_name == "/arg/other"
    assert settings.master_uri == "http://10.0.0.8:2/"
    assert settings.host == "10.0.0.3"
    assert gather(("__hostname:=mine", "__ip:=10.0.0.3"), environ).host == "mine"


def test_a_log_file_is_in_the_folder_of_logs() -> None:
    environ = {"ROS_LOG_DIR": "/logs"}
    assert gather(environ=environ).log_file is None
    assert gather(("__log:=a.log",), environ).log_file == Path("/logs/a.log")
    assert gather(("__log:=/elsewhere/a.log",), environ).log_file == Path("/elsewhere/a.log")


def test_reachable_host_is_served_on_all_interfaces() -> None:
    """A host that others can reach is served on all interfaces."""
    settings = gather(environ={"ROS_HOSTNAME": "robot.local", "ROS_IP": "10.0.0.2"})
    assert settings.host == "robot.local"
    assert settings.bind == "0.0.0.0"
    assert gather(environ={"ROS_HOSTNAME": "localhost"}).bind == "127.0.0.1"


def test_private_parameters_are_yaml() -> None:
    assert gather(("_a:=1", "_b:=[1, x]", "_c:=true", "_d:=")).parameters == {
        "a": 1,
        "b": [1, "x"],
        "c": True,
        "d": "",
    }
    assert parse_value("{broken") == "{broken"


def test_anonymous_names_are_names() -> None:
    assert is_base_name(anonymous_name("node"))
