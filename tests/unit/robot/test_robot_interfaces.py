"""The four roles of a robot's interfaces, without network."""

from __future__ import annotations

import asyncio
import json

import pytest
from support.robot_interfaces import STRING, Setup, ros_string, shown

from rce.aio.queues import OverflowPolicy
from rce.link import (
    InterfaceError,
)
from rce.protocol.messages import DataMessage
from rce.ros.types import TypeRegistry
from rce_robot.exceptions import MisdirectedError, UnreadableError
from rce_robot.outgoing import Outgoing, Serialized

# Which interfaces there are


@pytest.mark.parametrize(
    ("type_", "cls", "word"),
    [
        ("PublisherInterface", STRING, "container"),
        ("PublisherConverter", "no_such/Type", "no_such/Type"),
        ("ServiceClientConverter", STRING, STRING),
    ],
)
def test_a_bad_spec_is_refused_in_words(type_: str, cls: str, word: str) -> None:
    with pytest.raises(InterfaceError, match=word):
        Setup(type_, cls)


def test_a_forwarder_needs_no_definition() -> None:
    Setup("PublisherForwarder", "no_such/Type")


# Topics


def test_from_the_robot() -> None:
    json_end, raw_end = Setup("SubscriberConverter"), Setup("SubscriberForwarder")
    json_end.take({"data": "x"})
    raw_end.take(memoryview(b"bytes"))
    assert json_end.port.sent == [ros_string("x")]
    assert raw_end.port.sent == [b"bytes"]


@pytest.mark.parametrize(
    ("type_", "msg"),
    [
        ("SubscriberConverter", {"data": 5}),
        ("SubscriberConverter", b"x"),
        ("SubscriberForwarder", {"data": "x"}),
    ],
)
def test_what_does_not_fit_is_refused_and_named(type_: str, msg: object) -> None:
    setup = Setup(type_)
    with pytest.raises(UnreadableError, match="tag, msgID 7: "):
        setup.take(msg, "7")
    assert not setup.port.sent


def test_an_ignored_field_is_told_once() -> None:
    setup = Setup("SubscriberConverter")
    for _ in range(3):
        setup.take({"data": "x", "extra": 1})
    setup.take({"data": "x", "other": 1})
    assert len(setup.port.sent) == 4
    assert len(setup.robot.reports) == 2
    assert "extra" in setup.robot.reports[0]


def test_long_ignored_fields_are_cut() -> None:
    """The engine remembers and reports the beginning of a long name of a field only."""
    setup = Setup("SubscriberConverter")
    for number in range(3):
        setup.take({"data": "x", "k" * 1_000_000 + str(number): 1})
    assert len(setup.port.sent) == 3
    (report,) = setup.robot.reports
    assert len(report) < 300
    assert "kkk... was ignored" in report


async def test_remembered_warnings_count_as_held() -> None:
    """Remembered warnings count for the user's memory, and are forgotten when it is short."""
    setup = Setup("SubscriberConverter")
    for number in range(300):
        setup.take({"data": "x", f"k{number}": 1})
    assert len(setup.robot.reports) == 256
    held = setup.robot.holdings.bytes
    assert held > 256 * 500
    setup.robot.holdings.shed(held)
    assert setup.robot.holdings.bytes == 0
    setup.take({"data": "x", "k0": 1})
    assert len(setup.robot.reports) == 257
    await setup.interface.close()
    assert setup.robot.holdings.bytes == 0


def test_to_the_robot() -> None:
    setup = Setup("PublisherConverter")
    setup.interface.receive(ros_string("x"), latched=False)
    ((message, overflow),) = setup.robot.data
    assert shown(message) == {"iTag": "tag", "type": STRING, "msgID": "nil", "msg": {"data": "x"}}
    assert overflow is OverflowPolicy.DROP_OLDEST
    with pytest.raises(MisdirectedError):
        setup.take({"data": "x"})


@pytest.mark.parametrize("queue_size", [0, 1])
def test_an_interface_says_how_many_messages_may_wait(queue_size: int) -> None:
    setup = Setup("PublisherForwarder", queue_size=queue_size)
    setup.interface.receive(ros_string("x"), latched=False)
    assert setup.robot.queue_sizes == [queue_size]


def test_a_broken_message_of_a_peer_is_told() -> None:
    setup = Setup("PublisherConverter")
    setup.interface.receive(b"no string", latched=False)
    assert not setup.robot.data
    assert setup.robot.reports[0].startswith("tag: ")


def test_a_forwarded_payload_is_not_copied() -> None:
    setup = Setup("PublisherForwarder")
    payload = bytes(100_000)
    setup.interface.receive(payload, latched=False)
    ((message, _),) = setup.robot.data
    assert isinstance(message, Serialized)
    assert message.payload is payload  # in one frame
    header = json.loads(message.prefix[3:])
    assert header == {"iTag": "tag", "type": STRING, "msgID": "nil"}
    split = message.latched("5.1").split()
    ((id_, body),) = split.binaries
    assert body is payload
    assert shown(split) == {"latch": "5.1", **header, "msg*": id_.decode()}
    assert len(id_) == 32


def test_last_latched_message_waits_for_returning_robot() -> None:
    """The last latched message waits for a robot that comes back."""
    setup = Setup("PublisherConverter")
    setup.interface.on_active(True)
    setup.interface.receive(ros_string("map"), latched=True)
    setup.interface.receive(ros_string("other"), latched=False)
    setup.robot.data.clear()
    setup.interface.robot_joined()
    assert [shown(message)["msg"]["data"] for message, _ in setup.robot.data] == ["map"]
    assert setup.robot.states == [True, True]


def test_each_source_of_peers_has_its_latched_message() -> None:
    """A robot that comes back gets all that are in force, and is told which these are."""
    setup = Setup("PublisherConverter")
    for source, text in (("1", "old"), ("2", "of 2"), ("3", "of 3"), ("1", "of 1")):
        setup.interface.receive_latched(ros_string(text), source)
    setup.interface.unlatch(["3"])
    assert setup.robot.sources == [("2", "1")]
    setup.robot.data.clear()
    setup.interface.robot_joined()
    assert [shown(message)["msg"]["data"] for message, _ in setup.robot.data] == ["of 2", "of 1"]
    assert setup.robot.sources[-1] == ("2", "1")
    assert setup.robot.holdings.bytes == len(ros_string("of 2")) + len(ros_string("of 1"))


def test_what_a_robot_latches_lasts_as_long_as_it_says() -> None:
    """Also while it is away; but not when a client comes that does not name its sources."""
    setup = Setup("SubscriberConverter")
    for source in ("1", "2"):
        message = DataMessage("tag", STRING, {"data": source}, latch=source)
        setup.interface.take(message)
    setup.take({"data": "not latched"})
    setup.interface.robot_left()
    assert setup.port.latched == {source: ros_string(source) for source in ("1", "2")}
    setup.interface.robot_joined()
    setup.interface.keep_latched(("2",))
    assert list(setup.port.latched) == ["2"]
    setup.robot.knows_sources = False
    setup.interface.robot_joined()
    assert not setup.port.latched


async def test_sources_end_after_what_waits_to_be_converted() -> None:
    setup = Setup("SubscriberConverter", "sensor_msgs/Image")
    picture = {"height": 1, "width": 1, "encoding": "mono8", "step": 1, "data": b"x"}
    setup.interface.take(DataMessage("tag", "sensor_msgs/Image", picture, latch="1"))
    setup.interface.keep_latched(())
    await asyncio.gather(*setup.robot.work)
    assert len(setup.port.sent) == 1
    assert not setup.port.latched


async def test_pictures_are_converted_elsewhere_and_in_order() -> None:
    setup = Setup("PublisherConverter", "sensor_msgs/Image")
    image = TypeRegistry().message("sensor_msgs/Image")
    for number in range(3):
        picture = image.new(height=1, width=1, encoding="mono8", step=1, data=bytes([number]))
        setup.interface.receive(image.serialize(picture), latched=False)
    assert not setup.robot.data
    await asyncio.gather(*setup.robot.work)
    assert len(setup.robot.data) == 3
    for message, _ in setup.robot.data:
        assert isinstance(message, Outgoing)
        ((_, frame),) = message.binaries
        assert bytes(frame)[32:40] == b"\x89PNG\r\n\x1a\n"


async def test_pictures_that_come_too_fast_are_dropped_and_counted() -> None:
    setup = Setup("PublisherConverter", "sensor_msgs/Image")
    image = TypeRegistry().message("sensor_msgs/Image")
    payload = image.serialize(image.new(height=1, width=1, encoding="mono8", step=1, data=b"x"))
    for _ in range(10):
        setup.interface.receive(payload, latched=False)
    await asyncio.gather(*setup.robot.work)
    assert len(setup.robot.data) + setup.robot.dropped == 10
    assert setup.robot.dropped > 0


# Large messages


# Services
