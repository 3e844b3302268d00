"""The short form of a robot's wiring."""

from __future__ import annotations

import json
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rce.config.client import ClientConfig, loads
from rce.config.exceptions import ConfigError

POSE = "geometry_msgs/PoseStamped"
HEAD: dict[str, Any] = {
    "url": "http://localhost:9000/",
    "userID": "u",
    "password": "p",
    "robotID": "R1",
    "containers": [{"cTag": "c1"}, {"cTag": "c2"}],
}


def read(*bridges: dict[str, Any], types: dict[int, str] | None = None, **more: object) -> ClientConfig:
    return loads(json.dumps({**HEAD, "bridges": bridges, **more}), types=types)


def faults(*bridges: dict[str, Any], **more: Any) -> list[str]:
    with pytest.raises(ConfigError) as caught:
        read(*bridges, **more)
    return [str(fault) for fault in caught.value.faults]


def interfaces(config: ClientConfig) -> dict[str, tuple[str, str, str]]:
    return {
        one.path: (one.interface.type, one.interface.message_type, one.interface.addr)
        for one in config.interfaces
    }


def connections(config: ClientConfig) -> list[tuple[str, str]]:
    return [(one.tag_a, one.tag_b) for one in config.connections]


def test_topic_from_the_robot_to_two_containers() -> None:
    config = read({"topic": "/pose", "type": POSE, "from": "robot", "to": ["c1:/R1/pose", "c2"]})
    assert interfaces(config) == {
        "R1/pose_sender": ("SubscriberForwarder", POSE, "/pose"),
        "c1/R1_R1_pose_receiver": ("PublisherInterface", POSE, "/R1/pose"),
        "c2/R1_pose_receiver": ("PublisherInterface", POSE, "/pose"),
    }
    assert connections(config) == [
        ("R1/pose_sender", "c1/R1_R1_pose_receiver"),
        ("R1/pose_sender", "c2/R1_pose_receiver"),
    ]


def test_topic_to_the_robot_as_json() -> None:
    config = read({"topic": "/goal", "type": POSE, "from": "c1", "to": "robot", "form": "converter"})
    assert interfaces(config)["R1/goal_receiver"] == ("PublisherConverter", POSE, "/goal")


def test_topic_between_containers() -> None:
    config = read({"topic": "/map", "type": "nav_msgs/OccupancyGrid", "from": "c1", "to": "c2"})
    assert connections(config) == [("c1/R1_map_sender", "c2/R1_map_receiver")]


def test_service_in_a_container() -> None:
    config = read(
        {"service": "/plan", "type": "nav_msgs/GetPlan", "server": "c1", "clients": ["robot", "c2"]}
    )
    assert interfaces(config) == {
        "c1/R1_plan_server": ("ServiceClientInterface", "nav_msgs/GetPlan", "/plan"),
        "R1/plan_client": ("ServiceProviderForwarder", "nav_msgs/GetPlan", "/plan"),
        "c2/R1_plan_client": ("ServiceProviderInterface", "nav_msgs/GetPlan", "/plan"),
    }


@pytest.mark.parametrize("type_", ["move_base_msgs/MoveBase", "move_base_msgs/MoveBaseAction"])
def test_action_is_five_topics(type_: str) -> None:
    config = read({"action": "move_base", "type": type_, "server": "robot", "clients": "c1:/R1/move_base"})
    goal, cancel, status, feedback, result = connections(config)
    assert goal == ("c1/R1_R1_move_base_goal_sender", "R1/move_base_goal_receiver")
    assert cancel == ("c1/R1_R1_move_base_cancel_sender", "R1/move_base_cancel_receiver")
    assert status == ("R1/move_base_status_sender", "c1/R1_R1_move_base_status_receiver")
    assert [one[0] for one in (feedback, result)] == [
        "R1/move_base_feedback_sender",
        "R1/move_base_result_sender",
    ]
    assert interfaces(config)[goal[0]][1:] == ("move_base_msgs/MoveBaseActionGoal", "/R1/move_base/goal")


def test_interfaces_of_the_file_are_used_again() -> None:
    own = {"eTag": "R1", "iTag": "mine", "iType": "SubscriberConverter", "iCls": POSE, "addr": "/pose"}
    bridges: list[dict[str, Any]] = [
        {"topic": "/pose", "type": POSE, "from": "robot", "to": "c1"},
        {"topic": "pose", "type": POSE, "from": "robot", "to": ["c1", "c2"]},
    ]
    config = read(*bridges, interfaces=[own])
    assert connections(config) == [("R1/mine", "c1/R1_pose_receiver"), ("R1/mine", "c2/R1_pose_receiver")]
    assert len(config.interfaces) == 3


def test_connections_of_the_file_may_name_interfaces_of_bridges() -> None:
    config = read(
        {"topic": "/pose", "type": POSE, "from": "robot", "to": "c1"},
        interfaces=[
            {"eTag": "c2", "iTag": "other", "iType": "PublisherInterface", "iCls": POSE, "addr": "/x"}
        ],
        connections=[{"tagA": "R1/pose_sender", "tagB": "c2/other"}],
    )
    assert connections(config)[0] == ("R1/pose_sender", "c2/other")


@pytest.mark.parametrize(
    ("bridge", "fault"),
    [
        ({"from": "robot", "to": "c1"}, "must have one of the keys topic, service and action"),
        ({"topic": "/a", "service": "/a"}, "must have one of the keys topic, service and action"),
        ({"topic": "/a", "server": "c1"}, "a bridge of a topic must have the key 'from'"),
        ({"topic": "/a", "from": "robot", "to": "c1", "clients": "c2"}, "must not have the key 'clients'"),
        ({"service": "/a", "server": "c1"}, "a bridge of a service must have the key 'clients'"),
        ({"topic": "/a", "from": "robot", "to": "robot"}, "joins robot:/a twice"),
        ({"topic": "/a", "from": "robot", "to": ["c1", "c1"]}, "joins c1:/a twice"),
    ],
)
def test_wrong_keys(bridge: dict[str, Any], fault: str) -> None:
    (found,) = faults({"type": POSE, **bridge})
    assert found.startswith("bridges[0]: ")
    assert fault in found


@pytest.mark.parametrize("end", ["c1:", "c1:a b", ":/a", "c 1", "c1:/a:/b"])
def test_wrong_end(end: str) -> None:
    (found,) = faults({"topic": "/a", "type": POSE, "from": "robot", "to": ["c1", end]})
    assert found == (
        "bridges[0].to[1]: must be 'robot' or a container's cTag, with ':/NAME' where its name differs; "
        f"it is {end!r}"
    )


def test_two_types_of_one_topic_are_refused() -> None:
    (found, *_) = faults(
        {"topic": "/a", "type": POSE, "from": "robot", "to": "c1"},
        {"topic": "/a", "type": "std_msgs/String", "from": "robot", "to": "c2"},
    )
    assert (
        found == "bridges[1]: R1:/a carries std_msgs/String here and geometry_msgs/PoseStamped in bridges[0]"
    )


def test_two_servers_of_one_client_are_refused() -> None:
    found = faults(
        {"service": "/a", "type": "std_srvs/Empty", "server": "c1", "clients": "robot"},
        {"service": "/a", "type": "std_srvs/Empty", "server": "c2", "clients": "robot"},
    )
    assert found == ["bridges[1]: 'R1/a_client' takes one connection, and that is in bridges[0]"]


def test_a_type_may_come_from_the_graph() -> None:
    bridge = {"topic": "/a", "from": "robot", "to": "c1"}
    assert faults(bridge) == [
        "bridges[0].type: is missing; only rce-ros can read it, from the robot's ROS graph"
    ]
    draft = loads(json.dumps({**HEAD, "bridges": [bridge]}), draft=True)
    assert draft.interfaces == ()
    assert [one.robot_name for one in draft.untyped.values()] == ["/a"]
    assert len(read(bridge, types={0: POSE}).connections) == 1


def test_names_that_make_the_same_tag_are_told_apart() -> None:
    config = read(
        {"topic": "/a/b", "type": POSE, "from": "robot", "to": "c1"},
        {"topic": "/a_b", "type": POSE, "from": "robot", "to": "c1"},
        {"topic": "/" + "x" * 200, "type": POSE, "from": "robot", "to": "c1"},
    )
    assert len(interfaces(config)) == 6
    assert all(len(one.interface.tag) <= 128 for one in config.interfaces)


_names = st.from_regex(r"/[a-z][a-z0-9_]{0,3}(/[a-z0-9_]{1,3}){0,2}", fullmatch=True)


@given(st.lists(_names, min_size=1, max_size=6))
def test_every_bridge_has_its_connections_in_any_order(names: list[str]) -> None:
    bridges = [{"topic": name, "type": POSE, "from": "robot", "to": ["c1", "c2"]} for name in names]
    config = read(*bridges)
    addresses = {one.path: one.interface.addr for one in config.interfaces}
    assert {(addresses[a], addresses[b], b.partition("/")[0]) for a, b in connections(config)} == {
        (name, name, container) for name in names for container in ("c1", "c2")
    }
