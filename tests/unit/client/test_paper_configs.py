"""The configs of the paper's wiring, as made and as shipped."""

from __future__ import annotations

from pathlib import Path

import pytest

from rce.config.client import ClientConfig, load, loads
from rce.config.documents import write_items
from rce.model.names import Role
from rce_fleet.paper_wiring import paper_planner_config, paper_robot_config
from rce_fleet.wiring import FleetAccount

PAPER = Path(__file__).parents[3] / "configs" / "paper"
NUMBERS = (1, 2, 3)


def shipped() -> list[ClientConfig]:
    return [load(PAPER / f"{name}.config") for name in ("planner", *(f"robot{number}" for number in NUMBERS))]


@pytest.mark.parametrize("number", NUMBERS)
def test_shipped_robot_files_are_what_is_made(number: int) -> None:
    assert (PAPER / f"robot{number}.config").read_text() == write_items(paper_robot_config(number))


def test_the_shipped_planner_file_is_what_is_made() -> None:
    assert (PAPER / "planner.config").read_text() == write_items(paper_planner_config())


def test_one_container_which_is_the_planners() -> None:
    planner, *robots = shipped()
    assert [item.tag for item in planner.containers] == ["cTag_01"]
    assert not any(robot.containers for robot in robots)
    assert {item.container for robot in robots for item in robot.nodes} == {"cTag_01"}


def test_files_are_in_the_long_form_with_the_papers_node() -> None:
    for number, config in zip(NUMBERS, shipped()[1:], strict=True):
        assert not config.bridges
        (item,) = config.nodes
        assert (item.node.pkg, item.node.exe) == ("move_client", "move_client_pthread")
        assert item.node.args.split()[0] == f"/Robot{number}/goalNodesList"


def test_every_interface_is_connected_with_its_complement() -> None:
    configs = shipped()
    interfaces = {item.path: item.interface for config in configs for item in config.interfaces}
    assert len(interfaces) == sum(len(config.interfaces) for config in configs), "no tag is used twice"
    used = set()
    for config in configs:
        for link in config.connections:
            a, b = interfaces[link.tag_a], interfaces[link.tag_b]
            assert (a.kind.role, b.kind.role) == (Role.SUBSCRIBER, Role.PUBLISHER)
            assert a.message_type == b.message_type
            used |= {link.tag_a, link.tag_b}
    assert used == set(interfaces)


def test_any_number_of_robots_and_any_engine() -> None:
    account = FleetAccount(url="http://cloud:1/", user="u", password="p")
    config = loads(write_items(paper_planner_config(12, account)))
    assert (config.user, config.robot) == ("u", "planner")
    topics = {item.interface.addr for item in config.interfaces}
    assert {f"/Robot12/{name}" for name in ("amcl_pose", "goalNodesList", "cancelGoal")} <= topics
