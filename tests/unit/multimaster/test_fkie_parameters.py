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


def test_unknown_parameters_are_named_and_have_no_effect(caplog: pytest.LogCaptureFixture) -> None:
    """Launch files of fkie's nodes have parameters of other releases, and start ours."""
    values = {"log_level": "INFO", "master_uri": "http://x/", "mcast_group": "224.0.0.1"}
    settings = discovery_settings(values)
    lists = sync_lists({"log_level": "INFO", "sync_topic": ["/pose"], "sync_topics": ["/map"]})
    assert (settings.master_uri, settings.mcast_group, lists.sync_topics) == ("", "224.0.0.1", ["/map"])
    warned = [message.partition("; known are ") for message in caplog.messages]
    assert [(text, known.split(", ")[0]) for text, _, known in warned] == [
        ("~log_level is not a parameter of master_discovery and has no effect", "active_request_after"),
        ("~master_uri is not a parameter of master_discovery and has no effect", "active_request_after"),
        ("~log_level is not a parameter of master_sync and has no effect", "do_not_sync"),
        ("~sync_topic is not a parameter of master_sync and has no effect", "do_not_sync"),
    ]


def test_some_parameters_of_a_sync_are_not_needed(caplog: pytest.LogCaptureFixture) -> None:
    values = {"resync_on_reconnect": True, "resync_on_reconnect_timeout": 5, "sync_topics_on_demand": True}
    assert sync_lists(values) == sync_lists({})
    assert caplog.messages == []


def test_parameters_of_a_sync(tmp_path: Path) -> None:
    file = tmp_path / "lists.yaml"
    file.write_text("sync_topics: [/map]\nsync_remote_nodes: true\n")
    values = {"sync_topics": ["/pose"], "ignore_hosts": "[old]", "interface_url": f"file://{file}"}
    lists = sync_lists({**values, "resync_on_reconnect": True})
    assert (lists.sync_topics, lists.ignore_hosts) == (["/map", "/pose"], ["old"])
    assert lists.sync_remote_nodes
    assert not sync_lists({"interface_url": "."}).sync_remote_nodes


def test_wrong_parameters_of_a_sync_are_named() -> None:
    with pytest.raises(MultimasterError, match="interface_url must be a file"):
        sync_lists({"interface_url": "http://x/y"})
