"""Large messages of a robot, which are converted elsewhere."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from support.client_types import ros_string as utf8_string
from support.robot_interfaces import SERVICE, STRING, Setup, ros_string, shown

from rce.protocol.stream import LargeData
from rce.protocol.weight import Address
from rce_robot.exceptions import BusyError
from rce_robot.topics import ToRobot

if TYPE_CHECKING:
    from collections.abc import Callable


async def until(done: Callable[[], bool]) -> None:
    async with asyncio.timeout(60):
        while not done():
            await asyncio.sleep(0)


def large(msg: str, tag: str = "tag", cls: str = STRING, msg_id: str = "nil", latch: str = "") -> LargeData:
    text = f'{{"type":"DM","data":{{"iTag":"{tag}","type":"{cls}","msgID":"{msg_id}","msg":{msg}}}}}'
    return LargeData(Address(tag, cls, msg_id, latch), text.encode())


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


async def test_large_message_with_binary_values_keeps_its_place() -> None:
    """Messages that come while it is read do not overtake it; its binary values count as held."""
    setup = Setup("SubscriberConverter", "sensor_msgs/CompressedImage")
    id_ = "ab" * 16
    setup.robot.binaries[id_] = memoryview(b"pixels")
    message = large(f'{{"data*":"{id_}"}}', cls="sensor_msgs/CompressedImage")
    held: list[int] = []

    async def note() -> None:
        held.append(setup.robot.holdings.bytes)

    setup.robot.converting = note
    setup.interface.take_large(message)
    setup.take({"data": b"later"})
    await asyncio.gather(*setup.robot.work)
    assert [payload[-6:] for payload in setup.port.sent] == [b"pixels", b"\0later"]
    assert held[1] - held[0] == len(b"pixels")
    assert setup.robot.holdings.bytes == 0


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


async def test_answers_that_wait_for_conversion_are_held() -> None:
    setup = Setup("ServiceProviderConverter", SERVICE)
    setup.port.answer = b"\x01" + heavy("ö")
    size = len(setup.port.answer)
    converted = asyncio.Event()
    setup.robot.converting = converted.wait
    for number in range(3):
        setup.take({"data": True}, f"id{number}")
    await until(lambda: setup.robot.holdings.bytes == 3 * size)
    setup.robot.holdings.shed(1)
    assert setup.robot.holdings.bytes == 2 * size
    converted.set()
    await asyncio.gather(*setup.robot.work, return_exceptions=True)
    assert setup.robot.holdings.bytes == 0
    assert setup.robot.reports == ["tag, msgID id0: memory is short; the call was given up"]
    assert [shown(message)["msgID"] for message, _ in setup.robot.data] == ["id1", "id2"]


def heavy(letter: str) -> bytes:
    """A message whose text takes long to write."""
    return utf8_string(letter * (1 << 20))


def joined_with_latched(setup: Setup) -> ToRobot:
    """Latch six heavy messages, then let the robot come, and more messages; no conversion is done yet."""
    assert isinstance(setup.interface, ToRobot)
    setup.robot.connected = False
    for source, letter in enumerate("äöüéèà"):
        setup.interface.receive_latched(heavy(letter), str(source))
    setup.robot.connected = True
    setup.interface.robot_joined()
    return setup.interface


def texts(setup: Setup) -> list[str]:
    """Return the first letters of what the robot got."""
    return [shown(message)["msg"]["data"][:1] for message, _ in setup.robot.data]


async def test_robot_that_comes_gets_every_latched_message() -> None:
    """More of them wait for their conversion than other messages may."""
    setup = Setup("PublisherConverter")
    converted = asyncio.Event()
    setup.robot.converting = converted.wait
    interface = joined_with_latched(setup)
    assert setup.robot.holdings.bytes == 6 * len(heavy("ä")), "each is counted once"
    for letter in "abcdef":
        interface.receive(ros_string(letter), latched=False)
    assert setup.robot.dropped == 2
    converted.set()
    await asyncio.gather(*setup.robot.work)
    assert texts(setup) == [*"äöüéèà", *"cdef"]
    assert setup.robot.holdings.bytes == 6 * len(heavy("ä"))


async def test_latched_message_that_ends_while_it_waits_is_counted() -> None:
    setup = Setup("PublisherConverter")
    converted = asyncio.Event()
    setup.robot.converting = converted.wait
    size = len(heavy("ä"))
    interface = joined_with_latched(setup)
    await asyncio.sleep(0)
    interface.unlatch(["0", "1"])  # the first is converted, the second waits
    interface.receive_latched(heavy("ß"), "2")
    assert setup.robot.holdings.bytes == 7 * size
    setup.robot.holdings.shed(1)  # the latched message of source 3 is the oldest that can be dropped
    assert setup.robot.holdings.bytes == 6 * size
    assert setup.robot.latched_dropped == 1
    converted.set()
    await asyncio.gather(*setup.robot.work)
    assert texts(setup) == [*"äöüèàß"]
    assert setup.robot.holdings.bytes == 3 * size


async def test_latched_messages_of_the_robot_are_not_dropped_to_make_room() -> None:
    """Neither are the sources that remain."""
    setup = Setup("SubscriberConverter")
    converted = asyncio.Event()
    setup.robot.converting = converted.wait
    for source in range(6):
        setup.interface.take_large(large(f'{{"data":"m{source}"}}', latch=str(source)))
    setup.interface.keep_latched(["0"])
    setup.interface.keep_latched([str(source) for source in range(1, 6)])
    refused = 0
    for number in range(6):
        try:
            setup.interface.take_large(large(f'{{"data":"{number}"}}'))
        except BusyError:
            refused += 1
    assert refused == 2
    converted.set()
    await asyncio.gather(*setup.robot.work)
    assert setup.port.latched == {str(source): ros_string(f"m{source}") for source in range(1, 6)}
    assert setup.port.sent[6:] == [ros_string(str(number)) for number in range(2, 6)]
    assert setup.robot.reports == []
    assert setup.robot.holdings.bytes == 0


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
