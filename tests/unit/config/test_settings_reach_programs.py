"""``rce up`` hands each program its settings as one document; nothing is lost on the way."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import pytest
import typer
import typer.main
from msgspec.structs import replace
from typer import Typer

from rce.cli.up import bound_to, plan, programs, warning
from rce.config.fields import fields_of, sections_of
from rce.config.settings import (
    ContainerSettings,
    EngineSettings,
    LogLevel,
    MasterSettings,
    RobotSettings,
    Runtime,
    TlsSettings,
)
from rce.own_process import machine_memory
from rce.tls.choice import WARNED_VARIABLE
from rce_container.command import OPTIONS as CONTAINER
from rce_container.command import app as container
from rce_master.command import OPTIONS as MASTER
from rce_master.command import app as master
from rce_robot.command import OPTIONS as ROBOT
from rce_robot.command import app as robot

if TYPE_CHECKING:
    from rce.cli.settings import SettingsOptions

APPS: dict[str, tuple[SettingsOptions, Typer]] = {
    "rce_master": (MASTER, master),
    "rce_robot": (ROBOT, robot),
    "rce_container": (CONTAINER, container),
}
SETTINGS = EngineSettings(
    dev=True,
    state_dir=Path("/state"),
    secret_file=Path("/secret"),
    master_host="127.0.0.2",
    log_level=LogLevel.DEBUG,
    log_dir=Path("/log"),
    master=MasterSettings(
        bind="127.0.0.2",
        http_port=1,
        token_lifetime=3.5,
        max_cpu=1.5,
        max_memory=5,
        trusted_proxies=("10.0.0.0/8",),
    ),
    tls=TlsSettings(
        enabled=True,
        certificates=Path("/c"),
        name="cloud",
        cert=Path("/public.pem"),
        key=Path("/public.key"),
    ),
    robot=RobotSettings(count=2, public_host="robots.example.org", origins=("https://a.example",)),
    container=ContainerSettings(
        runtime=Runtime.PROCESS,
        package_path=(Path("/p"), Path("/q")),
        images=("debian:12", "/srv/rootfs"),
        offer_images=False,
        home_size=1 << 30,
        allow_requirements=True,
        pip_args="--no-index --pre",
        link_port=0,
    ),
)


def received(settings: EngineSettings) -> dict[str, EngineSettings]:
    """What each program reads from the command line that ``rce up`` gives it."""
    found = {}
    for program in programs(settings):
        _, _, _, module, *arguments = program.argv
        options, app = APPS[module]
        context = typer.main.get_command(app).make_context(module, arguments)
        found[program.name] = options.read(module, context.params)
    return found


def test_what_is_set_arrives() -> None:
    found = received(SETTINGS)
    assert found["master"] == SETTINGS
    assert found["container"] == SETTINGS
    shared = replace(SETTINGS.robot, memory=machine_memory() // 2 // 2)
    assert found["robot1"].robot == replace(shared, link_port=10030)
    assert found["robot2"].robot == replace(shared, ws_port=9011, link_port=10032)
    assert (str(found["robot1"].log_dir), str(found["robot2"].log_dir)) == ("/log", "/log/robot2")


def test_defaults_arrive() -> None:
    found = received(EngineSettings())
    assert set(found) == {"master", "robot", "container"}
    assert {each.master_host for each in found.values()} == {"127.0.0.1"}
    assert (found["robot"].robot.link_port, found["container"].container.link_port) == (10030, 10031)


@pytest.mark.parametrize(("memory", "each"), [(8 << 30, 2 << 30), (0, machine_memory() // 2 // 4)])
def test_robot_programs_share_the_memory(memory: int, each: int) -> None:
    found = received(EngineSettings(dev=True, robot=RobotSettings(count=4, memory=memory)))
    assert [found[f"robot{number}"].robot.memory for number in range(1, 5)] == [each] * 4
    alone = received(EngineSettings(dev=True, robot=RobotSettings(memory=memory)))
    assert alone["robot"].robot.memory == memory


@pytest.mark.parametrize(
    ("host", "master"),
    [("10.0.0.7", "10.0.0.7"), ("0.0.0.0", "127.0.0.1"), ("::", "127.0.0.1"), ("cloud.local", "cloud.local")],
)
def test_task_sets_dial_the_address_at_which_the_master_listens(host: str, master: str) -> None:
    found = received(bound_to(host, EngineSettings()))
    assert {one.master_host for one in found.values()} == {master}
    assert received(bound_to(host, SETTINGS))["robot1"].master_host == "127.0.0.2", "as it is set"


def test_one_command_for_all_programs_takes_no_store_in_etcd() -> None:
    settings = EngineSettings(master=MasterSettings(store="etcd://10.0.0.1"))
    with pytest.raises(typer.BadParameter, match="start rce-master, rce-robot and rce-container"):
        plan(settings)


@pytest.mark.parametrize("host", ["10.0.0.7", "0.0.0.0"])
def test_one_address_for_all_programs(host: str) -> None:
    found = received(bound_to(host, SETTINGS))
    assert {one.master.bind for one in found.values()} == {host}, "the command line counts, even here"
    assert {one.robot.bind for one in found.values()} == {host}
    assert {one.container.bind for one in found.values()} == {host}


@pytest.mark.parametrize(
    ("host", "tls", "warns"),
    [
        ("0.0.0.0", TlsSettings(), "passwords and messages travel in clear"),
        ("127.0.0.1", TlsSettings(), ""),
        ("0.0.0.0", TlsSettings(enabled=True), ""),
        ("0.0.0.0", TlsSettings(cert=Path("/public.pem")), "messages between task sets, and their secret,"),
        ("127.0.0.1", TlsSettings(cert=Path("/public.pem")), ""),
    ],
)
def test_one_warning_beyond_loopback_without_tls(
    host: str, tls: TlsSettings, warns: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of ``rce up`` itself; its programs are told to be silent."""
    monkeypatch.delenv(WARNED_VARIABLE, raising=False)
    settings = bound_to(host, EngineSettings(tls=tls))
    text = warning(settings)
    assert (text is not None) == bool(warns)
    assert (text or "").startswith(warns)
    assert "\n" not in (text or "")
    assert all(WARNED_VARIABLE in program.env for program in programs(settings))


def test_bad_address_is_refused() -> None:
    with pytest.raises(typer.BadParameter, match="--bind must be a host name"):
        bound_to("a b", SETTINGS)


def test_every_setting_is_an_option_of_its_program() -> None:
    given = {option.place for options, _ in APPS.values() for option in options.options}
    elsewhere = {("", "state_dir"), ("", "master_host"), ("robot", "count"), ("master", "replicas")}
    for section, kind in {"": EngineSettings, **sections_of(EngineSettings)}.items():
        for name in fields_of(kind):
            assert (section, name) in given | elsewhere


@pytest.mark.parametrize(("options", "app"), APPS.values(), ids=APPS)
def test_no_option_comes_twice(options: SettingsOptions, app: Typer) -> None:
    names = [name for param in typer.main.get_command(app).params for name in param.opts]
    assert len(names) == len(set(names))
    assert {f"--{option.name}" for option in options.options} < set(names)
