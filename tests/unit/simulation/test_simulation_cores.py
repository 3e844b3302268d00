"""Which ROS graph a robot of a world joins."""

from __future__ import annotations

from rce_fleet.drivers.cores import Cores

A, B = "http://127.0.0.1:1/", "http://127.0.0.1:2/"


def test_without_any_every_robot_has_a_graph_of_its_own() -> None:
    assert Cores.read([]).of("Robot1") is None


def test_one_for_everybody_and_one_for_a_robot() -> None:
    cores = Cores.read([A, f"Robot2={B}"])
    assert cores.of("Robot1") == A
    assert cores.of("Robot2") == B


def test_an_address_with_an_equals_sign_is_no_robots() -> None:
    strange = "http://host/?x=1"
    assert Cores.read([strange]).of("Robot1") == strange
