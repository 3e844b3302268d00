"""The four roles of a robot's interfaces, without network."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable, Collection, Coroutine, Sequence
from typing import Any

import pytest

from rce.aio.queues import OverflowPolicy
from rce.guard.holdings import Holding, Holdings
from rce.link import (
    Buffer,
    CallTimeoutError,
    InterfaceError,
    NotConnectedError,
    OverloadedError,
    PeerFaultError,
    PeerLostError,
)
from rce.model.names import InterfaceType
from rce.model.specs import InterfaceSpec
from rce.protocol.messages import CallId, DataMessage, ErrorReport
from rce.protocol.stream import LargeData
from rce.protocol.weight import Address
from rce.ros.types import TypeRegistry
from rce_robot.conversion import Result
from rce_robot.conversion.jobs import HEAD, Job, decode_job, pack
from rce_robot.conversion.worker import Worker
from rce_robot.doors.base import Queued
from rce_robot.exceptions import BusyError, MisdirectedError, UnreadableError
from rce_robot.factory import FormFactory
from rce_robot.interface import RobotInterface
from rce_robot.interfaces import make_interface
from rce_robot.outgoing import Outgoing, Rendered, Serialized
from rce_robot.services import AnsweredByRobot

STRING = "std_msgs/String"
SERVICE = "std_srvs/SetBool"


WORKER = Worker(FormFactory(TypeRegistry()), 1 << 30)


class FakePort:
    def __init__(self, type_: str, cls: str) -> None:
        self.spec = InterfaceSpec(tag="tag", type=type_, message_type=cls)
        self.sent: list[bytes] = []
        self.latched: dict[str, bytes] = {}
        self.answer: bytes | Exception | asyncio.Future[bytes] = b""

    def send(self, payload: Buffer, *, latched: bool = False, source: str = "") -> None:
        self.sent.append(bytes(payload))
        if latched:
            self.latched[source] = bytes(payload)

    def keep_latched(self, sources: Collection[str]) -> None:
        self.latched = {source: self.latched[source] for source in sources if source in self.latched}

    async def call(self, payload: Buffer, *, timeout: float | None = None) -> bytes:
        self.sent.append(bytes(payload))
        if isinstance(self.answer, Exception):
            raise self.answer
        return self.answer if isinstance(self.answer, bytes) else await self.answer


class FakeRobot:
    def __init__(self) -> None:
        self.connected = True
        self.room = True
        self.data: list[tuple[Rendered, OverflowPolicy]] = []
        self.urgent: list[Rendered] = []
        self.reports: list[str] = []
        self.states: list[bool] = []
        self.dropped = 0
        self.work: list[asyncio.Task[None]] = []
        self.gone: list[RobotInterface] = []
        self.holdings = Holdings()
        self.latched_dropped = 0
        self.knows_sources = True
        self.sources: list[tuple[str, ...]] = []
        self.awaited: list[tuple[LargeData, list[str]]] = []

    def send_data(self, tag: str, message: Queued, overflow: OverflowPolicy) -> bool:
        rendered = message.render()
        if rendered is not None and self.room:
            self.data.append((rendered, overflow))
        return self.room

    def send_urgent(self, message: Queued) -> bool:
        rendered = message.render()
        if rendered is not None and self.room:
            self.urgent.append(rendered)
        return self.room

    def report(self, problem: str, call: CallId | None = None) -> None:
        self.reports.append(ErrorReport(problem=problem, call=call).text)

    def show_active(self, tag: str, active: bool) -> None:
        self.states.append(active)

    def send_latched(self, tag: str, source: str, message: Queued, *, shared: bool) -> None:
        self.send_data(tag, message, OverflowPolicy.DROP_OLDEST)

    def send_sources(self, tag: str, sources: Sequence[str]) -> None:
        self.sources.append(tuple(sources))

    def drop_latched(self, tag: str, source: str) -> None:
        self.latched_dropped += 1

    def hold(self, size: int, give_up: Callable[[], object] | None = None) -> Holding:
        return self.holdings.hold(size, give_up)

    async def convert(self, job: Job, parts: Sequence[Any]) -> tuple[Result, list[memoryview]]:
        """Do in this process what a worker process does."""
        await asyncio.sleep(0)
        described, *rest = pack(job, parts)
        result, made = WORKER.do(
            decode_job(described[HEAD.size + 8 * (len(parts) + 1) :]), list(map(bytes, rest))
        )
        return result, [memoryview(part) for part in made]

    def await_binaries(self, large: LargeData, ids: Sequence[str]) -> None:
        self.awaited.append((large, list(ids)))

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

    def take(self, msg: object, msg_id: str = "nil") -> None:
        self.interface.take(
            DataMessage(i_tag="tag", message_type=self.port.spec.message_type, msg=msg, msg_id=msg_id)
        )


def shown(message: Rendered) -> Any:
    assert isinstance(message, Outgoing)
    return json.loads(bytes(message.text))["data"]


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


def test_to_the_robot() -> None:
    setup = Setup("PublisherConverter")
    setup.interface.receive(ros_string("x"), latched=False)
    ((message, overflow),) = setup.robot.data
    assert shown(message) == {"iTag": "tag", "type": STRING, "msgID": "nil", "msg": {"data": "x"}}
    assert overflow is OverflowPolicy.DROP_OLDEST
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


def large(msg: str, tag: str = "tag", cls: str = STRING, msg_id: str = "nil") -> LargeData:
    text = f'{{"type":"DM","data":{{"iTag":"{tag}","type":"{cls}","msgID":"{msg_id}","msg":{msg}}}}}'
    return LargeData(Address(tag, cls, msg_id), text.encode())


async def test_a_large_message_is_converted_elsewhere_and_in_order() -> None:
    setup = Setup("SubscriberConverter")
    setup.interface.take_large(large('{"data":"first"}'))
    setup.take({"data": "second"})
    assert setup.port.sent == []
    assert setup.robot.holdings.bytes > 0
    await asyncio.gather(*setup.robot.work)
    assert setup.port.sent == [ros_string("first"), ros_string("second")]
    assert setup.robot.holdings.bytes == 0
    setup.take({"data": "third"})
    assert setup.port.sent[2:] == [ros_string("third")]


async def test_wrong_large_message_harms_no_other() -> None:
    """A large message that is wrong is told and harms no other."""
    setup = Setup("SubscriberConverter")
    setup.interface.take_large(large('{"data":5}'))
    setup.interface.take_large(large("[" * 100 + "]" * 100))
    setup.interface.take_large(large("[" + "[]," * 200_000 + "[]]"))
    setup.take({"data": "good"})
    await asyncio.gather(*setup.robot.work)
    assert setup.port.sent == [ros_string("good")]
    wrong, deep, many = setup.robot.reports
    assert wrong == "tag: data: 5 is not a string"
    assert deep == "tag: nested deeper than 64 levels"
    assert many.startswith("tag: a message of 200010 objects, lists and members is over the limit of 200000")


async def test_large_message_waits_for_its_binary_values() -> None:
    """A large message that refers to binary values waits for them."""
    setup = Setup("SubscriberConverter", "sensor_msgs/CompressedImage")
    id_ = "ab" * 16
    message = large(f'{{"format":"jpeg","data*":"{id_}"}}', cls="sensor_msgs/CompressedImage")
    setup.interface.take_large(message)
    await asyncio.gather(*setup.robot.work)
    assert setup.robot.awaited == [(message, [id_])]
    setup.interface.take_large(LargeData(message.address, message.text, {id_: memoryview(b"pixels")}))
    await asyncio.gather(*setup.robot.work)
    assert setup.port.sent[0].endswith(b"\x06\0\0\0pixels")


async def test_a_large_answer_of_the_robot_completes_its_call() -> None:
    setup = Setup("ServiceClientConverter", SERVICE)
    call = asyncio.ensure_future(setup.interface.serve(b"\x01"))
    await asyncio.sleep(0)
    msg_id = shown(setup.robot.urgent[0])["msgID"]
    setup.interface.take_large(large('{"success":true,"message":"big"}', cls=SERVICE, msg_id=msg_id))
    assert bytes(await call) == b"\x01" + ros_string("big")


async def test_a_call_is_given_up_when_memory_is_short() -> None:
    setup = Setup("ServiceProviderConverter", SERVICE)
    setup.port.answer = asyncio.get_running_loop().create_future()
    setup.take({"data": True}, "id1")
    await asyncio.sleep(0)
    assert setup.robot.holdings.bytes == 1
    setup.robot.holdings.shed(1)
    await asyncio.gather(*setup.robot.work, return_exceptions=True)
    assert setup.robot.holdings.bytes == 0
    assert setup.robot.reports == ["tag, msgID id1: memory is short; the call was given up"]


def test_a_latched_message_is_held_until_another_takes_its_place() -> None:
    setup = Setup("PublisherConverter")
    setup.interface.receive(ros_string("x" * 100), latched=True)
    assert setup.robot.holdings.bytes == 104
    setup.interface.receive(ros_string("x" * 50), latched=True)
    assert setup.robot.holdings.bytes == 54
    setup.robot.holdings.shed(1)
    assert setup.robot.holdings.bytes == 0
    assert setup.robot.latched_dropped == 1
    setup.robot.data.clear()
    setup.interface.robot_joined()
    assert setup.robot.data == []


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


@pytest.mark.parametrize("error", [NotConnectedError(), PeerFaultError("no"), CallTimeoutError("late")])
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
    assert overflow is OverflowPolicy.REFUSE
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
    with pytest.raises(CallTimeoutError):
        await setup.interface.serve(b"\x01")
    setup.robot.room = False
    with pytest.raises(OverloadedError):
        await setup.interface.serve(b"\x01")
    setup.robot.connected = False
    with pytest.raises(PeerLostError):
        await setup.interface.serve(b"\x01")
    with pytest.raises(MisdirectedError, match="no call"):
        setup.take({}, "unknown")


async def test_a_bad_request_of_a_peer_is_the_peers_to_know() -> None:
    setup = Setup("ServiceClientConverter", SERVICE)
    with pytest.raises(PeerFaultError):
        await setup.interface.serve(b"far too long for a bool")
    assert not setup.robot.reports


async def test_a_closed_interface_fails_its_callers() -> None:
    setup = Setup("ServiceClientConverter", SERVICE)
    assert isinstance(setup.interface, AnsweredByRobot)
    call = asyncio.ensure_future(setup.interface.serve(b"\x01"))
    await asyncio.sleep(0)
    await setup.interface.close()
    with pytest.raises(PeerLostError):
        await call
    assert setup.robot.gone == [setup.interface]
