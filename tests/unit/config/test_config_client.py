"""Client config files: what is read, and that every fault is listed with its path."""

from __future__ import annotations

import contextlib
import json
from typing import TYPE_CHECKING, Any

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from rce.config.client import ClientConfig, load, loads
from rce.config.exceptions import ConfigError
from rce.model.requests import (
    AddInterface,
    AddNode,
    ConfigureComponents,
    ConfigureConnections,
    Connection,
    CreateContainer,
    DestroyContainer,
    SetParameter,
)
from rce.model.specs import InterfaceSpec, NodeSpec, ParameterSpec, Resources, RestartPolicy

if TYPE_CHECKING:
    from pathlib import Path


def good() -> dict[str, Any]:
    return {
        "url": "http://127.0.0.1:9000/",
        "userID": "testUser",
        "password": "testUser",
        "robotID": "testRobot_1",
        "containers": [{"cTag": "cTag_01", "cpu": 1, "specialFeatures": ["gpu"]}],
        "nodes": [
            {
                "cTag": "cTag_01",
                "nTag": "move",
                "pkg": "fleet",
                "exe": "move_client.py",
                "args": "-v $(find fleet)/map.yaml",
                "namespace": "Robot1",
            }
        ],
        "parameters": [{"cTag": "cTag_01", "name": "cells", "value": [1, 2.5, "x", True]}],
        "interfaces": [
            {
                "eTag": "cTag_01",
                "iTag": "amclPoseReceiver_1",
                "iType": "PublisherInterface",
                "iCls": "geometry_msgs/PoseWithCovarianceStamped",
                "addr": "/Robot1/amcl_pose",
            },
            {
                "eTag": "testRobot_1",
                "iTag": "amclPoseSender_1",
                "iType": "SubscriberForwarder",
                "iCls": "geometry_msgs/PoseWithCovarianceStamped",
                "addr": "/amcl_pose",
            },
        ],
        "connections": [{"tagA": "testRobot_1/amclPoseSender_1", "tagB": "cTag_01/amclPoseReceiver_1"}],
    }


def faults(data: object) -> list[str]:
    with pytest.raises(ConfigError) as caught:
        loads(json.dumps(data))
    return [str(fault) for fault in caught.value.faults]


@pytest.mark.parametrize("name", ["robot.config", "robot.json"])
def test_json_file(tmp_path: Path, name: str) -> None:
    file = tmp_path / name
    file.write_text(json.dumps(good()))
    config = load(file)
    assert (config.user, config.robot, config.password.get_secret_value()) == (
        "testUser",
        "testRobot_1",
        "testUser",
    )
    assert [item.tag for item in config.robot_interfaces] == ["amclPoseSender_1"]
    assert "password=SecretStr('**********')" in repr(config)


@pytest.mark.parametrize("name", ["robot.config", "robot.yaml"])
def test_yaml_file(tmp_path: Path, name: str) -> None:
    file = tmp_path / name
    file.write_text(yaml.safe_dump(good()))
    assert load(file) == loads(json.dumps(good()))


def test_setup_makes_containers_then_components_then_connections() -> None:
    create, components, connections = loads(json.dumps(good())).setup()
    assert isinstance(create, CreateContainer)
    assert (create.tag, create.resources.cpu, create.resources.special_features) == (
        "cTag_01",
        1.0,
        ("gpu",),
    )
    assert isinstance(components, ConfigureComponents)
    assert components.add_nodes == (
        AddNode(
            container="cTag_01",
            node=NodeSpec(
                tag="move",
                pkg="fleet",
                exe="move_client.py",
                args="-v $(find fleet)/map.yaml",
                namespace="Robot1",
            ),
        ),
    )
    assert components.set_param == (
        SetParameter(container="cTag_01", parameter=ParameterSpec(name="cells", value=[1, 2.5, "x", True])),
    )
    assert components.add_interfaces[1] == AddInterface(
        endpoint="testRobot_1",
        interface=InterfaceSpec(
            tag="amclPoseSender_1",
            type="SubscriberForwarder",
            message_type="geometry_msgs/PoseWithCovarianceStamped",
            addr="/amcl_pose",
        ),
    )
    assert connections == ConfigureConnections(
        connect=(Connection(tag_a="testRobot_1/amclPoseSender_1", tag_b="cTag_01/amclPoseReceiver_1"),)
    )


def test_teardown_removes_the_same_in_reverse() -> None:
    disconnect, components, destroy = loads(json.dumps(good())).teardown()
    assert isinstance(disconnect, ConfigureConnections)
    assert len(disconnect.disconnect) == 1
    assert isinstance(components, ConfigureComponents)
    assert (
        len(components.remove_nodes),
        len(components.remove_interfaces),
        len(components.delete_param),
    ) == (1, 2, 1)
    assert destroy == DestroyContainer(tag="cTag_01")


def test_empty_config_asks_for_nothing() -> None:
    config = loads(json.dumps({key: good()[key] for key in ("url", "userID", "password", "robotID")}))
    assert config.setup() == config.teardown() == []


def test_references_to_others_are_legal() -> None:
    data = good()
    data["nodes"][0]["cTag"] = "fleetContainer"
    data["interfaces"][0]["eTag"] = "fleetContainer"
    data["connections"] = [
        {"tagA": "testRobot_1/amclPoseSender_1", "tagB": "fleetContainer/amclPoseReceiver_1"},
        {"tagA": "testRobot_1/amclPoseSender_1", "tagB": "otherRobot/anything"},
    ]
    assert isinstance(loads(json.dumps(data)), ClientConfig)


def test_every_fault_is_listed() -> None:
    data = good()
    del data["robotID"]
    data["url"] = "ftp://host"
    data["userID"] = "9"
    data["password"] = ""
    data["nodez"] = []
    data["containers"].append({"cTag": "c", "cpu": "much", "memory": -1})
    data["nodes"][0] |= {"exe": "/bin/sh", "nTag": 3}
    data["parameters"][0]["value"] = {"a": 1}
    data["interfaces"][0] |= {"iType": "Publisher", "iCls": "String"}
    data["connections"].append({"tagA": "x"})
    places = [fault.split(": ", 1)[0] for fault in faults(data)]
    assert sorted(places) == sorted(
        [
            "robotID",
            "url",
            "userID",
            "password",
            "nodez",
            "containers[1].cpu",
            "containers[1].memory",
            "nodes[0].exe",
            "nodes[0].nTag",
            "parameters[0].value",
            "interfaces[0].iType",
            "interfaces[0].iCls",
            "connections[1].tagA",
            "connections[1].tagB",
        ]
    )


@pytest.mark.parametrize("value", [float("nan"), [1, float("inf")], 2**31])
def test_a_parameter_that_no_server_keeps_is_refused(value: object) -> None:
    data = good()
    data["parameters"][0]["value"] = value
    (fault,) = faults(data)
    assert fault.startswith("parameters[0].value: must ")


def test_unknown_key_gets_a_suggestion() -> None:
    data = good()
    data["interfaces"][1]["itype"] = data["interfaces"][1].pop("iType")
    assert faults(data) == [
        "interfaces[1].iType: is missing",
        "interfaces[1].itype: is not a known key; did you mean 'iType'?",
    ]


def test_faults_of_items_and_relations_are_listed() -> None:
    """Faults of items and of their relations are listed together."""
    data = good()
    data["url"] = ""
    data["containers"].append({"cTag": "cTag_01"})
    assert [fault.split(":")[0] for fault in faults(data)] == ["url", "containers[1].cTag"]


@pytest.mark.parametrize(
    ("key", "place"),
    [
        ("containers", "containers[1].cTag"),
        ("nodes", "nodes[1].nTag"),
        ("parameters", "parameters[1].name"),
        ("interfaces", "interfaces[2].iTag"),
        ("connections", "connections[1]"),
    ],
)
def test_same_tag_twice(key: str, place: str) -> None:
    data = good()
    data[key].append(data[key][0])
    assert faults(data) == [f"{place}: is the same as in {key}[0]"]


def test_connection_is_the_same_in_either_direction() -> None:
    data = good()
    link = data["connections"][0]
    data["connections"].append({"tagA": link["tagB"], "tagB": link["tagA"]})
    assert faults(data) == ["connections[1]: is the same as in connections[0]"]


def test_connected_interfaces_must_complete_each_other() -> None:
    data = good()
    data["interfaces"][1] |= {"iType": "PublisherForwarder", "iCls": "std_msgs/String"}
    assert faults(data) == [
        (
            "connections[0]: testRobot_1/amclPoseSender_1 is a PublisherForwarder and needs a Subscriber,"
            " but cTag_01/amclPoseReceiver_1 is a PublisherInterface"
        ),
        (
            "connections[0]: testRobot_1/amclPoseSender_1 carries std_msgs/String,"
            " but cTag_01/amclPoseReceiver_1 carries geometry_msgs/PoseWithCovarianceStamped"
        ),
    ]


def test_connection_of_own_endpoint_needs_its_interface() -> None:
    data = good()
    data["connections"][0]["tagB"] = "cTag_01/typo"
    assert faults(data) == ["connections[0].tagB: there is no interface 'cTag_01/typo' in this file"]


def test_service_provider_takes_one_connection() -> None:
    data = good()
    data["interfaces"] = [
        {"eTag": "cTag_01", "iTag": "s", "iType": "ServiceClientInterface", "iCls": "a/B", "addr": "/s"},
        {"eTag": "cTag_01", "iTag": "t", "iType": "ServiceClientInterface", "iCls": "a/B", "addr": "/t"},
        {"eTag": "testRobot_1", "iTag": "p", "iType": "ServiceProviderConverter", "iCls": "a/B"},
    ]
    data["connections"] = [
        {"tagA": "testRobot_1/p", "tagB": "cTag_01/s"},
        {"tagA": "testRobot_1/p", "tagB": "cTag_01/t"},
    ]
    assert faults(data) == [
        "connections[1].tagA: 'testRobot_1/p' takes one connection, and that is in connections[0]"
    ]


@pytest.mark.parametrize(
    ("change", "place"),
    [
        ({"addr": ""}, "interfaces[0].addr"),
        ({"eTag": "testRobot_1"}, "interfaces[0].iType"),
        ({"iType": "PublisherConverter"}, "interfaces[0].iType"),
        ({"addr": "not a name"}, "interfaces[0].addr"),
    ],
)
def test_interface_must_fit_its_endpoint(change: dict[str, str], place: str) -> None:
    data = good()
    data["connections"] = []
    data["interfaces"][0] |= change
    assert [fault.split(":")[0] for fault in faults(data)] == [place]


def test_robot_is_no_container() -> None:
    data = good()
    data["containers"].append({"cTag": "testRobot_1"})
    data["nodes"][0]["cTag"] = data["parameters"][0]["cTag"] = "testRobot_1"
    places = {fault.split(":")[0] for fault in faults(data)}
    assert places >= {"containers[1].cTag", "nodes[0].cTag", "parameters[0].cTag"}


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ('{"url": 1,\n  "userID" 2}', "line 2, column 12: not valid JSON: Expecting ':' delimiter"),
        ('{"nodes": [{"cTag": "a", "cTag": "b"}]}', "nodes[0].cTag: is given more than once"),
        ("url: 1\nuserID: [\n", "line 3, column 1: no valid YAML"),
        ("url: 1\nurl: 2\n", "line 2, column 1: no valid YAML: key 'url' is given more than once"),
        ("? [a]\n: 1\n", "line 1, column 3: no valid YAML"),
        ("a: !!python/object/apply:os.system [id]\n", "line 1, column 4: no valid YAML"),
        ("[" * 100_000, "not valid JSON"),
        ("[]", "must be an object"),
        ("", "must be an object"),
    ],
)
def test_text_that_is_no_document(text: str, fault: str) -> None:
    with pytest.raises(ConfigError) as caught:
        loads(text, "robot.config")
    assert str(caught.value).startswith(f"robot.config: {fault}")


def test_yaml_bomb_is_refused() -> None:
    bomb = "a: &a [x]\n" + "".join(f"b{n}: *a\n" for n in range(200))
    with pytest.raises(ConfigError, match="too many aliases"):
        loads(bomb)


def test_unreadable_files(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cannot be read: No such file"):
        load(tmp_path / "missing.config")
    (tmp_path / "latin.config").write_bytes(b"{\xff")
    with pytest.raises(ConfigError, match="is not UTF-8 at byte 1"):
        load(tmp_path / "latin.config")
    (tmp_path / "large.config").write_bytes(b" " * (4 * 2**20 + 1))
    with pytest.raises(ConfigError, match="is longer than"):
        load(tmp_path / "large.config")


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.dictionaries(st.sampled_from(["cTag", "nTag", "iTag", "tagA", "x"]), inner, max_size=3)
    ),
    max_leaves=8,
)


@given(st.fixed_dictionaries({}, optional=dict.fromkeys(good(), JSON)))
def test_any_document_is_read_or_refused(change: dict[str, Any]) -> None:
    data = good() | change
    with contextlib.suppress(ConfigError):
        assert loads(json.dumps(data)).robot == data["robotID"]


@given(st.text())
def test_any_text_is_refused(text: str) -> None:
    with pytest.raises(ConfigError):
        loads(text)


def test_amounts_are_read_as_the_protocol_reads_them() -> None:
    data = good()
    requested = {
        "cpu": "50%",
        "memory": "256M",
        "bandwidth": "10Mbit",
        "wait": True,
        "network": "none",
        "image": "debian:12",
    }
    data["containers"][0] |= requested
    (made,) = [r for r in loads(json.dumps(data)).setup() if isinstance(r, CreateContainer)]
    assert made.wait
    assert made.resources == Resources(
        cpu=0.5,
        memory=256 << 20,
        bandwidth=1_250_000,
        image="debian:12",
        group=made.resources.group,
        group_ip=made.resources.group_ip,
        special_features=("gpu",),
        size=made.resources.size,
    )


def test_faults_of_requests_are_named_by_their_keys() -> None:
    data = good()
    data["containers"] = [
        {"cTag": "a", "memory": "lots", "network": "all"},
        {"cTag": "b", "network": "group"},
        {"cTag": "c", "group": "g", "groupIp": "10.0.0.2"},
        {"cTag": "d", "group": "g", "groupIp": "10.0.0.2/24"},
        {"cTag": "e", "memory": 200000000},
    ]
    data["nodes"] = []
    found = faults(data)
    assert [fault.split(": ")[0] for fault in found] == [
        "containers[0].memory",
        "containers[0].network",
        "containers[4].memory",
        "containers[1].group",
        "containers[3].groupIp",
    ]
    assert "must be one of none, group, host" in found[1]
    assert "is the address of containers[2] in the group 'g'" in found[-1]


def test_how_a_node_lives_is_passed_on() -> None:
    data = good()
    life = {
        "restart": "always",
        "maxRestarts": 2,
        "after": ["map"],
        "heartbeat": "/beat",
        "heartbeatTimeout": 1,
    }
    data["nodes"][0] |= life
    (made,) = [r for r in loads(json.dumps(data)).setup() if isinstance(r, ConfigureComponents)]
    (add,) = made.add_nodes
    node = add.node
    assert (node.restart, node.max_restarts, node.after, node.heartbeat, node.heartbeat_timeout) == (
        RestartPolicy.ALWAYS, 2, ("map",), "/beat", 1.0,
    )  # fmt: skip
    data["nodes"][0] |= {"restart": "often", "heartbeatTimeout": 0}
    assert [fault.split(": ")[0] for fault in faults(data)] == [
        "nodes[0].restart",
        "nodes[0].heartbeatTimeout",
    ]


def test_nodes_that_wait_for_one_another_are_found() -> None:
    data = good()
    data["nodes"] = [
        {"cTag": "cTag_01", "nTag": tag, "pkg": "p", "exe": "e", "after": [after]}
        for tag, after in ("ab", "bc", "ca")
    ]
    assert [fault.split(": ")[0] for fault in faults(data)] == [f"nodes[{index}].after" for index in range(3)]


@pytest.mark.parametrize("first", ["http://one:9000/", ["http://one:9000/"]])
def test_urls_are_further_masters(first: str | list[str]) -> None:
    data = good() | {"url": first, "urls": ["http://two:9000/", "http://one:9000/", "http://three:9000/"]}
    assert loads(json.dumps(data)).url == "http://one:9000/,http://two:9000/,http://three:9000/"


def test_urls_alone_name_the_masters() -> None:
    data = good() | {"urls": ["http://one:9000/", "http://two:9000/"]}
    del data["url"]
    assert loads(json.dumps(data)).url == "http://one:9000/,http://two:9000/"


@pytest.mark.parametrize("urls", ["http://two:9000/", 7, [7], {"a": "b"}, None])
def test_urls_must_be_a_list_of_addresses(urls: object) -> None:
    (fault,) = faults(good() | {"urls": urls})
    assert "urls must be a list" in fault


@pytest.mark.parametrize(
    "url",
    [
        "http://a b:9000/",
        "http://master:9000/a b",
        "http://mas\tter:9000/",
        "http://m,:9000/",
        "http://.:9000/",
    ],
)
def test_addresses_that_no_master_can_have_are_refused(url: str) -> None:
    """The client would try them again and again, as if the master were away."""
    (fault,) = faults(good() | {"url": url})
    assert fault.startswith("url: must be the master's address")


@pytest.mark.parametrize(
    "url", ["http://[fe80::1]:9000/", "https://köln.example/", "http://my_robot-1.local"]
)
def test_unusual_addresses_are_taken(url: str) -> None:
    assert loads(json.dumps(good() | {"url": url})).url == url


@pytest.mark.parametrize("urls", [["ftp://two"], ["http://"], [""]])
def test_urls_are_checked_like_url(urls: list[str]) -> None:
    (fault,) = faults(good() | {"urls": urls})
    assert fault.startswith("url: ")
