"""Which ROS graph a robot of a world joins."""

from __future__ import annotations

from rce_fleet.drivers.program import Cores

A, B = "http://127.0.0.1:1/", "http://127.0.0.1:2/"


def test_without_cores_each_robot_has_its_own_graph() -> None:
    assert Cores.read([]).of("Robot1") is None


def test_core_for_all_robots_and_core_for_one() -> None:
    cores = Cores.read([A, f"Robot2={B}"])
    assert cores.of("Robot1") == A
    assert cores.of("Robot2") == B


def test_uri_with_an_equals_sign_is_not_a_robots() -> None:
    strange = "http://host/?x=1"
    assert Cores.read([strange]).of("Robot1") == strange
