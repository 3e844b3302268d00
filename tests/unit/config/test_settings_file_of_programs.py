"""``--config`` of programs whose settings are their options: ``rce core``, ``rce ui`` and so on."""

from __future__ import annotations

import re
import subprocess
import sys
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import pytest
import typer.main

from rce.cli.main import GROUP, build_app
from rce.cli.program_files import keys_of
from rce.config.folders import configs_dir
from rce.config.settings import PROGRAM_SECTIONS

FILE = """
master: {http_port: 81}
tls: {enabled: true, name: fleet}
core: {port: 0, log: false}
discovery: {heartbeat_hz: 2, robot_host: [10.0.0.1, "10.0.0.2:11611"], send_mcast: false}
relay: {from: /a, to: /b, throttle: 5, lazy: true}
sync: {topics: /scan, relay_token: from-the-file, as: ["robot1=/one"]}
ui: {config: robot.config, port: 9999, certificate: station}
demo: {mode: single, robots: 5, auto: false}
"""


def command(name: str) -> Any:
    app = build_app([point for point in entry_points(group=GROUP) if point.name in (name, "ps")])
    return typer.main.get_command(app).commands[name]  # type: ignore[attr-defined]  # it is a group of commands


def read(name: str, *arguments: str) -> dict[str, Any]:
    return dict(command(name).make_context(f"rce {name}", list(arguments)).params)


@pytest.fixture
def file(tmp_path: Path) -> str:
    path = tmp_path / "engine.yaml"
    path.write_text(FILE)
    return str(path)


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("core", {"port": 0, "log": False, "bind": "127.0.0.1"}),
        (
            "discovery",
            {"heartbeat_hz": 2.0, "robot_hosts": ["10.0.0.1", "10.0.0.2:11611"], "send_mcast": False},
        ),
        ("relay", {"source": "/a", "target": "/b", "throttle": 5.0, "lazy": True, "latch": False}),
        ("sync", {"topics": ["/scan"], "relay_token": "from-the-file", "as_": ["robot1=/one"]}),
        ("ui", {"port": 9999, "tls": True, "certificate": "station"}),
        ("demo", {"mode": "single", "robots": 5, "auto": False}),
    ],
)
def test_program_reads_its_section(name: str, expected: dict[str, Any], file: str) -> None:
    found = read(name, "--config", file)
    assert {key: found[key] for key in expected} == expected


def test_option_wins_over_variable_and_variable_over_file(file: str, monkeypatch: pytest.MonkeyPatch) -> None:
    assert read("sync", "--config", file)["relay_token"] == "from-the-file"
    monkeypatch.setenv("RCE_RELAY_TOKEN", "from-the-variable")
    assert read("sync", "--config", file)["relay_token"] == "from-the-variable"
    assert read("sync", "--config", file, "--relay-token", "given")["relay_token"] == "given"
    assert read("relay", "--config", file, "/c", "/d")["source"] == "/c"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("core: {prot: 1}", "core.prot: is not a known key; did you mean 'port'?"),
        ("discovry: {}", "discovry: is not a known key; did you mean 'discovery'?"),
        (
            "core: {port: many}",
            "core.port: Input should be a valid integer, unable to parse string as an integer, found 'many'",
        ),
        ("core: {log: 3}", "core.log: must be true or false, found 3"),
        ("core: {port: [1, 2]}", "core.port: must be one value, found [1, 2]"),
        ("core: 5", "core: must be a mapping, found 5"),
        ("master: {http_prot: 1}", "master.http_prot: is not a known key; did you mean 'http_port'?"),
        ("core: {prot: 1, log: 3}", "core.log: must be true or false"),
    ],
)
def test_fault_in_the_file_is_told(
    text: str, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "engine.yaml"
    path.write_text(text)
    with pytest.raises(typer.Exit) as ended:
        read("core", "--config", str(path))
    assert ended.value.exit_code == 2
    told = capsys.readouterr().err
    assert f"{path}: {said}" in told


def test_actions_are_no_settings(file: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "engine.yaml"
    path.write_text("discovery: {list: true}")
    with pytest.raises(typer.Exit):
        read("discovery", "--config", str(path))
    assert "discovery.list: is not a known key" in capsys.readouterr().err
    assert "list_" not in {each.name for each in keys_of(command("discovery"), ("list",)).values()}


@pytest.mark.parametrize("name", PROGRAM_SECTIONS)
def test_shipped_file_says_every_default(name: str, tmp_path: Path) -> None:
    """With every key of the section in force, the program is set as without a file."""
    section = (configs_dir() / "engine.yaml").read_text().partition(f"\n{name}:\n")[2].split("\n\n")[0]
    lines = [line.strip("# ") for line in section.splitlines()]
    pairs = [line for line in lines if re.match(r"[a-z_]+:( \S+)?$", line)]
    assert pairs
    path = tmp_path / "engine.yaml"
    path.write_text(f"{name}:\n" + "".join(f"  {pair}\n" for pair in pairs))
    needed = ["/a", "/b"] if name == "relay" else []
    found, default = read(name, *needed, "--config", str(path)), read(name, *needed)
    shared = {"settings_file", "certificates"}
    assert {key: value for key, value in found.items() if key not in shared} == {
        key: value for key, value in default.items() if key not in shared
    }


@pytest.mark.slow
def test_core_runs_with_the_file(file: str) -> None:
    process = subprocess.Popen(
        [str(Path(sys.executable).parent / "rce"), "core", "--config", file],
        stdout=subprocess.PIPE,
        text=True,
    )
    with process:
        assert process.stdout is not None
        assert process.stdout.readline().startswith("rce core ready: ROS_MASTER_URI=http://")
        process.terminate()
        process.communicate()
    assert process.returncode == 0
