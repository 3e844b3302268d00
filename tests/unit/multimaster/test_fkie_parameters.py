"""fkie's private parameters, as discovery and sync take them."""

from __future__ import annotations

from pathlib import Path

import pytest

from rce.ros.cli.fkie_nodes import discovery_settings, names, sync_lists
from rce.ros.multimaster.errors import MultimasterError
from rce.ros.node.settings import parse_value


@pytest.mark.parametrize(
    "text",
    [
        "[/Robot1/amcl_pose,/map*]",  # what a shell leaves of ['/Robot1/amcl_pose','/map*']
        "['/Robot1/amcl_pose', '/map*']",
        '["/Robot1/amcl_pose", "/map*"]',
        "/Robot1/amcl_pose, /map*",
    ],
)
def test_lists_as_they_are_printed(text: str) -> None:
    assert names(parse_value(text)) == names(text) == ["/Robot1/amcl_pose", "/map*"]


def test_a_star_alone_is_no_yaml_but_a_pattern() -> None:
    assert names(parse_value("[*]")) == ["*"]
    assert names(parse_value("[]")) == names(parse_value("")) == []


def test_parameters_of_a_discovery() -> None:
    values = {"mcast_group": "224.0.0.1", "rosmaster_hz": 2, "rpc_port": 11612.0, "robot_hosts": "[a, b:1]"}
    settings = discovery_settings(values, master_uri="http://here:1/", node_name="finder")
    assert (settings.mcast_group, settings.rosmaster_hz, settings.rpc_port) == ("224.0.0.1", 2, 11612)
    assert (settings.robot_hosts, settings.master_uri, settings.node_name) == (
        ("a", "b:1"),
        "http://here:1/",
        "finder",
    )
    assert discovery_settings({}).mcast_group == "226.0.0.0"


@pytest.mark.parametrize(
    ("values", "fault"),
    [
        ({"mcast_grp": "224.0.0.1"}, "~mcast_grp is not a parameter of master_discovery; known are active_"),
        ({"master_uri": "http://x/"}, "~master_uri is not a parameter"),
        ({"mcast_port": "many"}, "~mcast_port must be of type int, not 'many'"),
        ({"rpc_port": 1.5}, "~rpc_port must be of type int, not 1.5"),
        ({"rpc_port": float("inf")}, "~rpc_port must be of type int, not inf"),
        ({"send_mcast": 1}, "~send_mcast must be of type bool, not 1"),
    ],
)
def test_wrong_parameters_of_a_discovery_are_named(values: dict[str, object], fault: str) -> None:
    with pytest.raises(MultimasterError) as caught:
        discovery_settings(values)
    assert fault in str(caught.value)


def test_parameters_of_a_sync(tmp_path: Path) -> None:
    file = tmp_path / "lists.yaml"
    file.write_text("sync_topics: [/map]\nsync_remote_nodes: true\n")
    values = {"sync_topics": ["/pose"], "ignore_hosts": "[old]", "interface_url": f"file://{file}"}
    lists = sync_lists({**values, "resync_on_reconnect": True})
    assert (lists.sync_topics, lists.ignore_hosts) == (["/map", "/pose"], ["old"])
    assert lists.sync_remote_nodes
    assert not sync_lists({"interface_url": "."}).sync_remote_nodes


def test_wrong_parameters_of_a_sync_are_named() -> None:
    with pytest.raises(MultimasterError, match="sync_topic is not a setting"):
        sync_lists({"sync_topic": ["/map"]})
    with pytest.raises(MultimasterError, match="interface_url must be a file"):
        sync_lists({"interface_url": "http://x/y"})
