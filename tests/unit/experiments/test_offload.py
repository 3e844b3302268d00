"""Tasks on the robot and in the cloud: wiring, figures, energy, and the order of the links."""

from __future__ import annotations

import importlib.util
import json
import os
import runpy
import time
from collections.abc import Awaitable, Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Self

import pytest

from rce.config.client import loads
from rce.config.documents import write_items
from rce_client.ros_bridge.explain import wires
from rce_fleet.experiments import offload as module
from rce_fleet.experiments.bench import CLIENT, Reading
from rce_fleet.experiments.experiment import NETBOOK_CORES, Link, Options, Trial
from rce_fleet.experiments.machines import Traffic
from rce_fleet.experiments.measures import Value
from rce_fleet.experiments.offload import (
    ARC,
    LINKS,
    PLANS,
    Offload,
    figures_of,
    links_of,
)
from rce_fleet.experiments.robot_energy import Effort, energy_of
from rce_fleet.experiments.robot_places import (
    CLOUD,
    MAPPING,
    NAVIGATION,
    NODES,
    ROBOT,
    config_of,
    scene_of_one_robot,
    write_packages,
)
from rce_fleet.experiments.task_judge import Answer, delays_of, read_orders
from rce_fleet.experiments.usage import Usage
from rce_fleet.simulation.battery import Battery, BatterySpec

ACCOUNT = {"url": "http://10.0.0.1:9000/", "userID": "U", "password": "P", "robotID": "R"}
USED = [
    Value("client.cpu", 0.1, "cores"),
    Value("server.cpu", 0.3, "cores"),
    Value("client.network_in", 1000.0, "B/s"),
    Value("client.network_out", 40000.0, "B/s"),
]


def report(**changes: Any) -> dict[str, Any]:
    values = {
        "seconds": 4.0,
        "metres": 1.0,
        "radians": 0.5,
        "success": True,
        "delays": {},
        "answered": {},
        "scans": 40,
    }
    return {**values, **changes}


def figures(task: str, told: dict[str, Any], *, has_share: bool = True) -> dict[str, float]:
    return {value.metric: value.value for value in figures_of(task, told, USED, has_share=has_share)}


def test_the_energy_is_what_the_simulated_battery_gives() -> None:
    spec = BatterySpec(capacity=1.0, idle=4.5, computing=18.0, computing_load=0.5, drive=12.0, turn=2.0)
    battery = Battery(spec)
    for _ in range(40):
        battery.step(0.1, 0.25, 0.125)
    taken = 3600 * (1.0 - battery.energy)
    assert energy_of(Effort(4.0, 1.0, 0.5, 0.5), spec) == pytest.approx(taken)


def test_a_computer_is_not_more_than_fully_loaded() -> None:
    assert energy_of(Effort(2.0, 0.0, 0.0, 1.3), BatterySpec(computing=10.0)) == 20.0


def test_figures_of_a_drive_to_a_goal() -> None:
    delays = {"command": [0.1, 0.2, 0.3], "pose": [9.0]}
    found = figures(NAVIGATION, report(delays=delays))
    load = 0.1 / NETBOOK_CORES
    assert found.pop("energy") == pytest.approx((4.5 + 18.0 * load) * 4.0 + 12.0 * 1.0 + 2.0 * 0.5)
    assert found == {
        "task_time": 4.0,
        "success": 1.0,
        "robot.cpu": 0.1,
        "server.cpu": 0.3,
        "robot.network_in": 1000.0,
        "robot.network_out": 40000.0,
        "control_delay": pytest.approx(0.2),
        "control_delay_p95": pytest.approx(0.29),
    }


def test_time_and_energy_of_planning_are_those_of_one_plan() -> None:
    found = figures("planning", report())
    assert found["task_time"] == 4.0 / PLANS
    assert found["energy"] == pytest.approx(figures(NAVIGATION, report())["energy"] / PLANS)
    assert "control_delay" not in found
    assert figures("planning", report(success=False))["task_time"] == 4.0


def test_mapping_tells_the_share_of_the_scans_that_were_used() -> None:
    found = figures(MAPPING, report(delays={"pose": [0.1] * 30}, answered={"pose": 10}))
    assert found["scans_used"] == 0.25
    assert found["control_delay"] == pytest.approx(0.1)
    assert figures(MAPPING, report())["scans_used"] == 0.0


def test_without_a_share_of_a_core_there_is_no_energy() -> None:
    found = figures(NAVIGATION, report(), has_share=False)
    assert not {"energy", "robot.cpu"} & set(found)


class Course:
    """Stands for the bench, the robot and its cloud; notes each drive: link, task, start and end."""

    def __init__(self) -> None:
        self.at: tuple[float, ...] = ()
        self.drives: list[tuple[Link, str, tuple[float, ...], tuple[float, ...]]] = []
        self.meters = {CLIENT: SimpleNamespace(limits=False)}
        self.folder = Path()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None: ...

    def __getattr__(self, name: str) -> Callable[..., Awaitable[None]]:
        """Return a way to start or end something, which does nothing."""

        async def nothing(*_: object, **__: object) -> None: ...

        return nothing

    async def set_rate(self, bits: float) -> None:
        self.rate = bits / 1e6

    async def set_delay(self, seconds: float) -> None:
        self.delay = 1000 * seconds

    async def read(self, machine: str) -> Reading:
        del machine
        return Reading(time.time(), Usage(0.0, 0), Traffic(0, 0, 0, 0))

    async def do(self, task: str, patience: float, **order: float) -> dict[str, Any]:
        del patience
        begin = self.at
        if task == MAPPING:
            self.at = (*begin, ARC["speed"]) if order["speed"] > 0 else begin[:-1]
        elif task != "planning":
            self.at = (order["x"], order["y"], order["yaw"])
        if task == NAVIGATION or (task == MAPPING and order["speed"] > 0):
            self.drives.append((Link(self.rate, self.delay), task, begin, self.at))
        return report()


@pytest.fixture
def drives_of(monkeypatch: pytest.MonkeyPatch) -> Callable[[str, int], Awaitable[list[Any]]]:
    """Return the drives of a run in a place with a seed."""
    monkeypatch.setattr(module, "SETTLE_S", 0.0)
    monkeypatch.setattr(module, "write_packages", lambda _: Path())

    async def drives_of(place: str, seed: int) -> list[Any]:
        course = Course()

        def robot(_bench: object, start: tuple[float, float]) -> Course:
            course.at = (*start, 0.0)
            return course

        monkeypatch.setattr(module, "Bench", lambda **_: course)
        monkeypatch.setattr(module, "Cloud", lambda *_: course)
        monkeypatch.setattr(module, "TaskRobot", robot)
        (setup,) = (one for one in Offload().setups(Options()) if dict(one.factors)["place"] == place)
        found = await Offload().measure(Trial(setup, Options(), seed))
        assert len({(one.condition, one.value.metric) for one in found}) == len(found)
        return course.drives

    return drives_of


async def test_each_link_and_place_has_the_same_drives(
    drives_of: Callable[[str, int], Awaitable[list[Any]]],
) -> None:
    """A stretch of the floor that takes longer must not count as a link's effect, nor as a place's."""
    runs = [await drives_of(place, seed) for place in (ROBOT, CLOUD) for seed in range(20)]
    drives = [drive for run in runs for drive in run]
    assert {drive[0] for drive in drives} == set(LINKS)
    assert {drive[1:] for drive in drives} == {
        (NAVIGATION, (2.5, 0.5, 0.0), (3.5, 0.5, 0.0)),
        (MAPPING, (2.5, 0.5, 0.0), (2.5, 0.5, 0.0, ARC["speed"])),
    }


async def test_links_are_measured_in_random_order(
    drives_of: Callable[[str, int], Awaitable[list[Any]]],
) -> None:
    orders = {tuple(link for link, *_ in await drives_of(CLOUD, seed)) for seed in range(40)}
    assert all(order[:4] == order[4:] and set(order) == set(LINKS) for order in orders)
    assert {order[0] for order in orders} == {order[3] for order in orders} == set(LINKS)


def test_on_the_robot_only_one_link_is_measured() -> None:
    assert links_of(ROBOT, Options()) == LINKS[:1]
    assert links_of(CLOUD, Options()) == LINKS
    assert links_of(CLOUD, Options(quick=True)) == LINKS[:1]


def test_links_that_are_measured_themselves_are_the_clouds() -> None:
    assert Offload().links(Options()) == LINKS
    assert not Offload().links(Options(systems=("single_master",)))


def test_setups_are_those_of_the_cloud_with_our_software() -> None:
    found = Offload().setups(Options())
    assert [(one.system, one.software, dict(one.factors)["place"]) for one in found] == [
        ("cloud", "rce", ROBOT),
        ("cloud", "rce", CLOUD),
    ]
    assert Offload().setups(Options(systems=("single_master",))) == []
    assert Offload().setups(Options(software=("ros",))) == []
    assert sum(Offload().seconds(setup, Options()) for setup in found) <= 80


@pytest.mark.parametrize(
    ("task", "down"),
    [
        (NAVIGATION, {"/raw_cmd_vel", "/move_base/stamped_cmd_vel", "/amcl_pose"}),
        (MAPPING, {"/pose"}),
    ],
)
def test_only_what_a_task_needs_crosses_the_link(task: str, down: set[str]) -> None:
    config = loads(write_items(config_of(task, ACCOUNT, (0.5, 0.5))))
    topics = [wire for wire in wires(config) if not wire.is_service]
    assert {wire.target_name for wire in topics if wire.target == config.robot} == down
    up = {wire.source_name for wire in topics if wire.source == config.robot}
    assert {"/scan", "/odom", "/tf", "/tf_static"} <= up
    orders = {"/move_base_simple/goal", "/move_base/cancel", "/initialpose"}
    assert up <= {"/scan", "/odom", "/tf", "/tf_static", *orders}
    assert {item.node.exe.removesuffix(".py") for item in config.nodes} <= set(NODES)


def test_a_containers_amcl_begins_where_the_robot_does() -> None:
    found = config_of(NAVIGATION, ACCOUNT, (2.5, 0.5))["parameters"]
    values = {item["name"]: item["value"] for item in found}
    assert (values["/amcl/initial_pose_x"], values["/amcl/initial_pose_y"]) == (2.5, 0.5)
    assert scene_of_one_robot((2.5, 0.5))["robots"] == [{"id": "Robot1", "at": [2.5, 0.5], "sensor": "lidar"}]


def test_a_containers_nodes_run_in_numpy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ran = []
    monkeypatch.setattr(runpy, "run_module", lambda name, **_: ran.append((name, os.environ["RCE_COMPILED"])))
    monkeypatch.setenv("RCE_COMPILED", "yes")
    for name in NODES:
        runpy.run_path(str(write_packages(tmp_path / name) / "numpy_nodes" / f"{name}.py"))
        assert importlib.util.find_spec(f"rce_fleet.nodes.{name}")
    assert ran == [(f"rce_fleet.nodes.{name}", "no") for name in NODES]


def test_orders_are_read_once_they_are_whole(tmp_path: Path) -> None:
    path = tmp_path / "orders.jsonl"
    assert read_orders(path, 0) == []
    path.write_text(json.dumps({"number": 1}) + "\n" + json.dumps({"number": 2}))
    assert read_orders(path, 0) == [{"number": 1}]
    assert read_orders(path, 1) == []


def test_a_scan_that_was_left_out_waits_for_a_newer_ones_answer() -> None:
    answers = [Answer(1.0, 1.25), Answer(1.0, 1.5), Answer(4.0, 6.0)]
    assert delays_of([1.0, 2.0, 3.0, 4.0, 5.0], answers) == [0.25, 4.0, 3.0, 2.0]
    assert delays_of([], answers) == delays_of([1.0], []) == []
