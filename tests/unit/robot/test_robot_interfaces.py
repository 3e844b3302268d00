"""The four roles of a robot's interfaces, without network."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Coroutine
from typing import Any

import pytest

from rce.control.model import InterfaceSpec
from rce.link import CallTimeout, InterfaceError, NotConnected, Overloaded, PeerFault, PeerLost
from rce.protocol.messages import DataMessage
from rce.protocol.names import InterfaceType
from rce.ros.types import TypeRegistry
from rce_robot.exceptions import BusyError, MisdirectedError, UnreadableError
from rce_robot.factory import FormFactory
from rce_robot.interface import RobotInterface
from rce_robot.interfaces import make_interface
from rce_robot.outbox import Outgoing, Overflow, Queued
from rce_robot.services import AnsweredByRobot

STRING = "std_msgs/String"
SERVICE = "std_srvs/SetBool"


class FakePort:
    def __init__(self, type_: str, cls: str) -> None:
        self.spec = InterfaceSpec(tag="tag", type=type_, cls=cls)
        self.sent: list[bytes] = []
        self.answer: bytes | Exception = b""

    def send(self, payload: Any, *, latched: bool = False) -> None:
        self.sent.append(bytes(payload))

    async def call(self, payload: Any, *, timeout: float | None = None) -> bytes:
        self.sent.append(bytes(payload))
        if isinstance(self.answer, Exception):
            raise self.answer
        return self.answer


class FakeRobot:
    def __init__(self) -> None:
        self.connected = True
        self.room = True
        self.data: list[tuple[Outgoing, Overflow]] = []
        self.urgent: list[Outgoing] = []
        self.reports: list[str] = []
        self.states: list[bool] = []
        self.dropped = 0
        self.work: list[asyncio.Task[None]] = []
        self.gone: list[RobotInterface] = []

    def send_data(self, tag: str, message: Queued, overflow: Overflow) -> bool:
        rendered = message.render()
        if rendered is not None and self.room:
            self.data.append((rendered, overflow))
        return self.room

    def send_urgent(self, message: Queued) -> bool:
        rendered = message.render()
        if rendered is not None and self.room:
            self.urgent.append(rendered)
        return self.room

    def report(self, text: str) -> None:
        self.reports.append(text)

    def show_active(self, tag: str, active: bool) -> None:
        self.states.append(active)

    def run(self, work: Coroutine[Any, Any, None]) -> bool:
        if self.room:
            self.work.append(asyncio.ensure_future(work))
        else:
            work.close()
        return self.room

    def count_dropped(self, tag: str) -> None:
        self.dropped += 1

    def closed(self, interface: RobotInterface) -> None:
        self.gone.append(interface)


class Setup:
    def __init__(self, type_: str, cls: str = STRING, call_timeout: float = 5.0) -> None:
        self.port = FakePort(type_, cls)
        self.robot = FakeRobot()
        kind = InterfaceType.parse(type_)
        forms = FormFactory(TypeRegistry()).pair(self.port.spec, kind)
        self.interface = make_interface(kind.role, self.port, self.robot, *forms, call_timeout=call_timeout)

    def take(self, msg: Any, msg_id: str = "nil") -> None:
        self.interface.take(DataMessage(i_tag="tag", type=self.port.spec.cls, msg=msg, msg_id=msg_id))


def shown(outgoing: Outgoing) -> Any:
    return json.loads(outgoing.text)["data"]


def ros_string(text: str) -> bytes:
    return len(text).to_bytes(4, "little") + text.encode()


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
def test_what_does_not_fit_is_refused_and_named(type_: str, msg: Any) -> None:
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


def test_to_the_robot() -> None:
    setup = Setup("PublisherConverter")
    setup.interface.receive(ros_string("x"), latched=False)
    ((message, overflow),) = setup.robot.data
    assert shown(message) == {"iTag": "tag", "type": STRING, "msgID": "nil", "msg": {"data": "x"}}
    assert overflow is Overflow.DROP_OLDEST
    with pytest.raises(MisdirectedError):
        setup.take({"data": "x"})


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
    ((id_, body),) = message.binaries
    assert body is payload
    assert shown(message)["msg*"].encode() == id_
    assert len(id_) == 32


def test_the_last_latched_message_waits_for_a_robot_that_comes_back() -> None:
    setup = Setup("PublisherConverter")
    setup.interface.on_active(True)
    setup.interface.receive(ros_string("map"), latched=True)
    setup.interface.receive(ros_string("other"), latched=False)
    setup.robot.data.clear()
    setup.interface.robot_joined()
    assert [shown(message)["msg"]["data"] for message, _ in setup.robot.data] == ["map"]
    assert setup.robot.states == [True, True]


async def test_pictures_are_converted_in_a_thread_and_in_order() -> None:
    setup = Setup("PublisherConverter", "sensor_msgs/Image")
    image = TypeRegistry().message("sensor_msgs/Image")
    for number in range(3):
        picture = image.new(height=1, width=1, encoding="mono8", step=1, data=bytes([number]))
        setup.interface.receive(image.serialize(picture), latched=False)
    assert not setup.robot.data
    await asyncio.gather(*setup.robot.work)
    assert len(setup.robot.data) == 3
    for message, _ in setup.robot.data:
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


# Services


async def test_the_robot_asks() -> None:
    setup = Setup("ServiceProviderConverter", SERVICE)
    setup.port.answer = b"\x01" + ros_string("done")
    setup.take({"data": True}, "id1")
    await asyncio.gather(*setup.robot.work)
    assert setup.port.sent == [b"\x01"]
    (message,) = setup.robot.urgent
    assert shown(message)["msgID"] == "id1"
    assert shown(message)["msg"] == {"success": True, "message": "done"}


@pytest.mark.parametrize("error", [NotConnected(), PeerFault("no"), CallTimeout("late")])
async def test_a_call_that_fails_is_told(error: Exception) -> None:
    setup = Setup("ServiceProviderConverter", SERVICE)
    setup.port.answer = error
    setup.take({"data": True}, "id1")
    await asyncio.gather(*setup.robot.work)
    assert setup.robot.reports == [f"tag, msgID id1: {error}"]


def test_too_many_calls_are_refused() -> None:
    setup = Setup("ServiceProviderConverter", SERVICE)
    setup.robot.room = False
    with pytest.raises(BusyError, match="id1"):
        setup.take({"data": True}, "id1")


async def test_a_large_answer_takes_the_data_lane_and_is_not_dropped() -> None:
    setup = Setup("ServiceProviderForwarder", SERVICE)
    setup.port.answer = bytes(1 << 20)
    setup.take(b"\x01", "id1")
    await asyncio.gather(*setup.robot.work)
    ((message, overflow),) = setup.robot.data
    assert overflow is Overflow.REFUSE
    assert message.size > 1 << 20


async def test_the_robot_answers() -> None:
    setup = Setup("ServiceClientConverter", SERVICE)
    calls = [asyncio.ensure_future(setup.interface.serve(bytes([number]))) for number in (0, 1)]
    await asyncio.sleep(0)
    for message in reversed(setup.robot.urgent):
        request = shown(message)
        setup.take({"success": request["msg"]["data"]}, request["msgID"])
    answers = await asyncio.gather(*calls)
    assert [bytes(answer) for answer in answers] == [b"\x00" + ros_string(""), b"\x01" + ros_string("")]


async def test_the_ways_in_which_the_robot_does_not_answer() -> None:
    setup = Setup("ServiceClientConverter", SERVICE, call_timeout=0.01)
    with pytest.raises(CallTimeout):
        await setup.interface.serve(b"\x01")
    setup.robot.room = False
    with pytest.raises(Overloaded):
        await setup.interface.serve(b"\x01")
    setup.robot.connected = False
    with pytest.raises(PeerLost):
        await setup.interface.serve(b"\x01")
    with pytest.raises(MisdirectedError, match="no call"):
        setup.take({}, "unknown")


async def test_a_bad_request_of_a_peer_is_the_peers_to_know() -> None:
    setup = Setup("ServiceClientConverter", SERVICE)
    with pytest.raises(PeerFault):
        await setup.interface.serve(b"far too long for a bool")
    assert not setup.robot.reports


async def test_a_closed_interface_fails_its_callers() -> None:
    setup = Setup("ServiceClientConverter", SERVICE)
    assert isinstance(setup.interface, AnsweredByRobot)
    call = asyncio.ensure_future(setup.interface.serve(b"\x01"))
    await asyncio.sleep(0)
    await setup.interface.close()
    with pytest.raises(PeerLost):
        await call
    assert setup.robot.gone == [setup.interface]
