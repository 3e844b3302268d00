"""``--config`` of ``rce-robot`` and ``rce-container``: the file stands behind the command line."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest
import typer.main
from typer.testing import CliRunner

from rce.config.resources import configs_dir
from rce_container.__main__ import app as container
from rce_robot.__main__ import app as robot

if TYPE_CHECKING:
    from pathlib import Path

FILE = """
secret_file: /etc/secret
master_host: cloud.example.org
master: {control_port: 81}
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


def parameters(app: typer.Typer, *arguments: str) -> dict[str, Any]:
    return typer.main.get_command(app).make_context("program", list(arguments)).params


@pytest.fixture
def file(tmp_path: Path) -> str:
    path = tmp_path / "engine.yaml"
    path.write_text(FILE)
    return str(path)


def test_robot_takes_its_settings_from_the_file(file: str) -> None:
    found = parameters(robot, "--config", file)
    assert found["master"] == "cloud.example.org"
    assert (found["control_port"], found["ws_port"]) == (81, 7)
    assert found["link_port"] is None, "what the file does not say stays as it is"
    assert list(found["origin"]) == ["https://a.example", "https://b.example"]
    assert found["user_memory"] == 1024
    assert str(found["secret_file"]) == "/etc/secret"
    assert [str(path) for path in found["package_path"]] == ["/srv/packages"]


def test_container_takes_its_settings_from_the_file(file: str) -> None:
    found = parameters(container, "--config", file)
    assert found["runtime"].value == "process"
    assert list(found["label"]) == ["gpu"]
    assert [str(path) for path in found["package_path_"]] == ["/srv/packages"]
    assert str(found["state_dir"]) == "/var/lib/rce/container"
    assert list(found["image"]) == ["/srv/rootfs"]
    assert (found["slots"], found["slot_memory"], found["home_size"]) == (12, 1024, 256)
    assert found["allow_requirements"]


def test_the_command_line_wins(file: str) -> None:
    found = parameters(robot, "10.0.0.1", "--ws-port", "8", "--config", file, "--origin", "https://c.example")
    assert (found["master"], found["ws_port"], found["control_port"]) == ("10.0.0.1", 8, 81)
    assert list(found["origin"]) == ["https://c.example"]


@pytest.mark.parametrize("app", [robot, container])
def test_without_a_file_somebody_must_name_the_master(app: typer.Typer) -> None:
    result = CliRunner().invoke(app, [])
    assert result.exit_code == 2
    assert "MASTER_IP" in result.output


@pytest.mark.parametrize("app", [robot, container])
def test_a_bad_file_is_refused_with_its_place(
    app: typer.Typer, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "bad.yaml"
    path.write_text("robot: {ws_port: many}")
    with pytest.raises(typer.Exit) as ended:
        parameters(app, "host", "--config", str(path))
    assert ended.value.exit_code == 2
    assert "robot.ws_port" in capsys.readouterr().err


@pytest.mark.parametrize("app", [robot, container])
def test_the_shipped_file_fits(app: typer.Typer) -> None:
    assert parameters(app, "--config", str(configs_dir() / "engine.yaml"))["master"] == "127.0.0.1"
