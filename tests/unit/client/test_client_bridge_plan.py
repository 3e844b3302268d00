"""What rce-ros makes of a config."""

from __future__ import annotations

import json
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, cast

import pytest

from rce.config.client import ClientConfig, loads
from rce.config.exceptions import ConfigError
from rce.model.names import Role
from rce.model.requests import ConfigureComponents, ConfigureConnections, CreateContainer
from rce.ros.types import TypeRegistry
from rce_client.interface_table import InterfaceTable
from rce_client.own_interfaces import OwnInterfaces
from rce_client.ros_bridge.bridge import lay
from rce_client.ros_bridge.plan import check, make_plan

if TYPE_CHECKING:
    from rce_client.session import Session

STRING = "std_msgs/String"


def own(tag: str, type_: str, addr: str = "", cls: str = STRING) -> dict[str, Any]:
    return {"eTag": "robot", "iTag": tag, "iType": type_, "iCls": cls} | ({"addr": addr} if addr else {})


def config(*interfaces: dict[str, Any], **parts: object) -> ClientConfig:
    base = {"url": "http://m/", "userID": "u", "password": "p", "robotID": "robot"}
    return loads(json.dumps({**base, "interfaces": list(interfaces), **parts}))


class Engine(OwnInterfaces):
    """A connection that notes how many messages may wait at the interfaces that are asked for."""

    robot_id = "robot"

    def __init__(self) -> None:
        self.sizes: dict[str, int] = {}
        session = SimpleNamespace(
            check_open=lambda: None,
            interfaces=InterfaceTable(),
            request=self._note,
            is_active=lambda _: False,
        )
        self._session = cast("Session", session)

    async def _note(self, request: ConfigureComponents) -> None:
        self.sizes.update((item.interface.tag, item.interface.queue_size) for item in request.add_interfaces)


async def advertise(addr: str, message_type: str) -> object:
    """Stand for a robot's ROS graph."""
    return addr, message_type


def test_converters_become_forwarders() -> None:
    plan = make_plan(config(own("a", "SubscriberConverter", "/a"), own("b", "PublisherForwarder", "/b")))
    assert [(span.tag, span.role, span.addr, span.type) for span in plan.spans] == [
        ("a", Role.SUBSCRIBER, "/a", "SubscriberForwarder"),
        ("b", Role.PUBLISHER, "/b", "PublisherForwarder"),
    ]


async def test_a_queue_size_of_the_file_holds_at_both_ends() -> None:
    """As for velocities, of which only the newest counts: at the robot's own queue, and in the engine."""
    up, down = own("up", "SubscriberForwarder", "/up"), own("down", "PublisherForwarder", "/down")
    other = own("other", "PublisherForwarder", "/other")
    plan = make_plan(config(up | {"queueSize": 2}, down | {"queueSize": 1}, other))
    engine, node = Engine(), SimpleNamespace(advertise=advertise)
    tasks = SimpleNamespace(spawn=lambda work, name: work.close())
    for span in plan.spans:
        await lay(span, cast("Any", engine), cast("Any", node), cast("Any", tasks))
    assert engine.sizes == {"up": 2, "down": 1, "other": 0}


def test_containers_first_own_interfaces_left_to_spans() -> None:
    """Containers come first and own interfaces are left to the spans."""
    other = own("in", "PublisherInterface", "/in") | {"eTag": "c1"}
    read = config(
        own("a", "SubscriberConverter", "/a"),
        other,
        containers=[{"cTag": "c1"}],
        connections=[{"tagA": "robot/a", "tagB": "c1/in"}],
    )
    plan = make_plan(read)
    first, second, third = plan.requests
    assert plan.first == 1
    assert isinstance(first, CreateContainer)
    assert isinstance(second, ConfigureComponents)
    assert [item.interface.tag for item in second.add_interfaces] == ["in"]
    assert isinstance(third, ConfigureConnections)
    assert plan.awaited == {"a"}


def test_interfaces_without_addr_are_made_as_they_are() -> None:
    plan = make_plan(config(own("a", "SubscriberConverter")))
    assert plan.spans == ()
    assert plan.unbridged == ("a",)
    (request,) = plan.requests
    assert isinstance(request, ConfigureComponents)
    assert request.add_interfaces[0].interface.type == "SubscriberConverter"


def test_a_topic_may_be_bridged_in_both_directions() -> None:
    read = config(own("a", "SubscriberConverter", "/x"), own("b", "PublisherConverter", "x"))
    check(read, TypeRegistry(), "file")
    assert [span.tag for span in make_plan(read).spans] == ["a", "b"]


def test_every_fault_is_found() -> None:
    read = config(
        own("a", "ServiceProviderConverter", "/x", "std_srvs/Empty"),
        own("b", "ServiceClientConverter", "x", "std_srvs/Empty"),
        own("c", "PublisherConverter", "/y", "none/Such"),
        own("d", "ServiceProviderConverter", "/z", "none/Service"),
        own("e", "PublisherConverter", cls="none/NotBridged"),
    )
    with pytest.raises(ConfigError) as caught:
        check(read, TypeRegistry(), "file")
    assert [fault.place for fault in caught.value.faults] == [
        "interfaces[1].addr",
        "interfaces[2].iCls",
        "interfaces[3].iCls",
    ]


def test_a_good_file_has_no_fault() -> None:
    check(
        config(own("a", "SubscriberConverter", "/x"), own("b", "SubscriberConverter", "/x")),
        TypeRegistry(),
        "f",
    )
