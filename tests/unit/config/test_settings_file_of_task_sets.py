"""``--config`` of the task sets: the file stands behind the command line."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
import typer.main
from typer.testing import CliRunner

from rce.cli.up import OPTIONS as UP
from rce.config import Secret
from rce.config.folders import configs_dir
from rce.config.settings import EngineSettings, Runtime
from rce_container import app as container_app
from rce_container.command import OPTIONS as CONTAINER
from rce_container.command import app as container
from rce_container.settings import ContainerSettings
from rce_master.command import OPTIONS as MASTER
from rce_master.command import app as master
from rce_robot import app as robot_app
from rce_robot.command import OPTIONS as ROBOT
from rce_robot.command import app as robot
from rce_robot.settings import RobotSettings

if TYPE_CHECKING:
    from pathlib import Path

    from rce.cli.settings import SettingsOptions

FILE = """
secret_file: /etc/secret
master_host: cloud.example.org
master: {control_port: 81, origins: [https://a.example]}
robot:
  ws_port: 7
  origins: [https://a.example, https://b.example]
  user_memory: 1G
container:
  runtime: process
  labels: [gpu]
  package_path: [/srv/packages]
  images: [/srv/rootfs]
  slots: 12
  slot_memory: 1G
  allow_requirements: true
state_dir: /var/lib/rce
"""


def settings(options: SettingsOptions, app: typer.Typer, *arguments: str) -> EngineSettings:
    params = typer.main.get_command(app).make_context("program", list(arguments)).params
    return options.read("program", params)


@pytest.fixture
def file(tmp_path: Path) -> str:
    path = tmp_path / "engine.yaml"
    path.write_text(FILE)
    return str(path)


def test_robot_takes_its_settings_from_the_file(file: str) -> None:
    found = settings(ROBOT, robot, "--config", file)
    assert found.master_host == "cloud.example.org"
    assert (found.master.control_port, found.robot.ws_port) == (81, 7)
    assert found.robot.link_port is None, "what the file does not say stays as it is"
    assert found.robot.origins == ("https://a.example", "https://b.example")
    assert found.robot.user_memory == 1 << 30
    assert str(found.secret_file) == "/etc/secret"
    assert [str(path) for path in found.container.package_path] == ["/srv/packages"]


def test_container_takes_its_settings_from_the_file(file: str) -> None:
    found = settings(CONTAINER, container, "--config", file)
    own = found.container
    assert own.runtime is Runtime.PROCESS
    assert own.labels == ("gpu",)
    assert own.images == ("/srv/rootfs",)
    assert str(found.container_state) == "/var/lib/rce/container"
    assert (own.slots, own.slot_memory, own.home_size) == (12, 1 << 30, 256 << 20)
    assert own.allow_requirements


@pytest.mark.parametrize(
    "text",
    [
        "masters: [a.example, 'b.example:82', '[::1]:83', '::2']",
        "masters: 'a.example, b.example:82,[::1]:83 , ::2'",
        "master_host: [a.example, 'b.example:82', '[::1]:83', '::2']",
        "master_host: a.example,b.example:82,[::1]:83,::2",
    ],
    ids=["masters, list", "masters, commas", "master_host, list", "master_host, commas"],
)
def test_task_sets_dial_all_masters_of_the_file(tmp_path: Path, text: str) -> None:
    path = tmp_path / "engine.yaml"
    path.write_text(f"{text}\nmaster: {{control_port: 81}}\n")
    secret = Secret("secret of the tests")
    found = settings(ROBOT, robot, "--config", str(path))
    robots = robot_app.App(
        master=found.master_host,
        control_port=found.master.control_port,
        secret=secret,
        packages=(),
        settings=RobotSettings(),
    )
    assert robots._places == [("a.example", 81), ("b.example", 82), ("::1", 83), ("::2", 81)]
    found = settings(CONTAINER, container, "--config", str(path))
    containers = container_app.App(
        master=found.master_host,
        control_port=found.master.control_port,
        secret=secret,
        settings=ContainerSettings(machine="m"),
    )
    addresses = ("ws://a.example:81", "ws://b.example:82", "ws://[::1]:83", "ws://[::2]:81")
    assert containers._masters(None).all == addresses


def test_master_takes_its_settings_from_the_file(file: str) -> None:
    found = settings(MASTER, master, "--config", file, "--state-dir", "/elsewhere", "--max-memory", "8G")
    assert found.master.origins == ("https://a.example",)
    assert (str(found.master_state), found.master.max_memory) == ("/elsewhere", 8 << 30)


def test_the_command_line_wins(file: str) -> None:
    found = settings(
        ROBOT, robot, "10.0.0.1", "--ws-port", "8", "--config", file, "--origin", "https://c.example"
    )
    assert (found.master_host, found.robot.ws_port, found.master.control_port) == ("10.0.0.1", 8, 81)
    assert found.robot.origins == ("https://c.example",)


def test_a_document_stands_between_file_and_options(file: str) -> None:
    document = '{"robot": {"ws_port": 1, "strangers": 5}}'
    found = settings(ROBOT, robot, "--settings", document, "--config", file, "--ws-port", "2")
    assert (found.robot.ws_port, found.robot.strangers, found.robot.user_memory) == (2, 5, 1 << 30)


@pytest.mark.parametrize("where", ["file", "option"])
def test_development_binds_loopback_unless_told_otherwise(tmp_path: Path, where: str) -> None:
    path = tmp_path / "engine.yaml"
    path.write_text("robot: {bind: 10.0.0.7}\n" + ("dev: true" if where == "file" else ""))
    arguments = ["--config", str(path), *(["--dev"] if where == "option" else [])]
    assert settings(ROBOT, robot, *arguments).robot.bind == "127.0.0.1"
    assert settings(ROBOT, robot, *arguments).master_host == "127.0.0.1"
    assert settings(ROBOT, robot, *arguments, "--bind", "10.0.0.8").robot.bind == "10.0.0.8"


@pytest.mark.parametrize("app", [robot, container])
def test_without_a_file_somebody_must_name_the_master(app: typer.Typer) -> None:
    result = CliRunner().invoke(app, [])
    assert result.exit_code == 2
    assert "MASTER_IP" in result.output


@pytest.mark.parametrize("app", [master, robot, container])
@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("robot: {ws_port: many}", "robot.ws_port: must be an integer, found 'many'"),
        ("robot: {bind: 3, link_port: 70000}", "robot.link_port: must be an integer <= 65535, found 70000"),
        ("[1]", "must be a mapping"),
        ("robot: {trusted_proxies: [10.0.0.7, here]}", "robot.trusted_proxies[1]: must be an IP address"),
        ("robot: {trusted_proxies: 10.0.0.7}", "robot.trusted_proxies: must be a list"),
    ],
)
def test_a_bad_file_is_refused_with_its_place(app: typer.Typer, text: str, told: str, tmp_path: Path) -> None:
    path = tmp_path / "bad.yaml"
    path.write_text(text)
    result = CliRunner().invoke(app, ["--config", str(path)])
    assert result.exit_code == 2
    assert told in result.output


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["--settings", "{"], "--settings: line 1, column 2: not valid JSON"),
        (["--settings", '{"robot": {"wsport": 1}}'], "did you mean 'ws_port'?"),
        (["--ws-port", "many"], "--ws-port must be an integer, found 'many'"),
        (["--user-memory", "1X"], "--user-memory must be a number of MB"),
        (["--log-level", "loud"], "--log-level must be one of debug, info, warning, error"),
    ],
)
def test_a_bad_command_line_is_refused(arguments: list[str], told: str) -> None:
    result = CliRunner().invoke(robot, ["host", *arguments], env={"COLUMNS": "300"})
    assert result.exit_code == 2
    assert told in result.output


@pytest.mark.parametrize(
    ("options", "app"), [(MASTER, master), (ROBOT, robot), (CONTAINER, container)], ids=["m", "r", "c"]
)
def test_the_shipped_file_fits(options: SettingsOptions, app: typer.Typer) -> None:
    argument = [] if app is master else ["127.0.0.1"]
    assert settings(options, app, *argument, "--config", str(configs_dir() / "engine.yaml")).dev is False


def test_up_takes_one_settings_file() -> None:
    with pytest.raises(typer.BadParameter, match="one settings file"):
        UP.read("rce up", {each.name: None for each in UP.parameters()} | {"config": "a", "file": "b"})
