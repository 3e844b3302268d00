"""Everything that can be set for ``rce up`` is understood by the programs that it starts."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import typer.main
from typer import Typer

from rce.cli.up import programs
from rce.config.settings import (
    ContainerSettings,
    EngineSettings,
    MasterSettings,
    RobotSettings,
    Runtime,
)
from rce_container.__main__ import app as container
from rce_master.__main__ import app as master
from rce_robot.__main__ import app as robot

APPS: dict[str, Typer] = {"rce_master": master, "rce_robot": robot, "rce_container": container}
SETTINGS = EngineSettings(
    dev=True,
    state_dir=Path("/state"),
    secret_file=Path("/secret"),
    master=MasterSettings(
        bind="127.0.0.2",
        http_port=1,
        control_port=2,
        token_lifetime=3.0,
        trusted_proxies=("10.0.0.0/8",),
        max_slots=4,
        max_cpu=1.5,
        max_memory=8 << 10,
    ),
    robot=RobotSettings(
        count=2,
        public_host="robots.example.org",
        origins=("https://a.example",),
        trusted_proxies=("10.1.1.1",),
    ),
    container=ContainerSettings(
        runtime=Runtime.PROCESS,
        labels=("gpu", "lidar"),
        package_path=(Path("/p"),),
        images=("debian:12", "/srv/rootfs"),
        slots=12,
        slot_memory=128,
        home_size="1G",
        log_days=0.5,
        allow_requirements=True,
        pip_args="--no-index --pre",
    ),
)


def parsed(settings: EngineSettings) -> dict[str, Any]:
    found = {}
    for program in programs(settings):
        _, _, module, *arguments = program.argv
        command = typer.main.get_command(APPS[module])
        found[program.name] = command.make_context(module, arguments)
    return found


@pytest.mark.parametrize("settings", [SETTINGS, EngineSettings()])
def test_every_option_is_known(settings: EngineSettings) -> None:
    assert {"master", "container"} < set(parsed(settings))


def test_what_is_set_arrives() -> None:
    contexts = parsed(SETTINGS)
    assert contexts["master"].params["token_lifetime"] == 3.0
    assert contexts["master"].params["max_slots"] == 4
    assert list(contexts["master"].params["trusted_proxy"]) == ["10.0.0.0/8"]
    assert list(contexts["robot1"].params["trusted_proxy"]) == ["10.1.1.1"]
    assert contexts["container"].params["allow_requirements"]
    assert contexts["container"].params["pip_args"] == "--no-index --pre"
    params = contexts["container"].params
    assert list(params["image"]) == ["debian:12", "/srv/rootfs"]
    sizes = ("slots", "slot_memory", "slot_processes", "home_size", "log_days", "log_space", "bundle_space")
    assert [params[name] for name in sizes] == [12, 128, 256, 1024, 0.5, 1024, 4096]
    assert contexts["master"].params["max_cpu"] == 1.5
    assert contexts["master"].params["max_memory"] == f"{8 << 30}B"
    assert contexts["robot2"].params["public_host"] == "robots.example.org"
    assert list(contexts["container"].params["label"]) == ["gpu", "lidar"]
