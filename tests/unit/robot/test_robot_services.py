"""Service calls from and to a robot."""

from __future__ import annotations

import asyncio
import gc

import pytest
from support.robot_interfaces import SERVICE, Setup, ros_string, shown

from rce.aio.queues import OverflowPolicy
from rce.link import (
    Buffer,
    CallTimeoutError,
    NotConnectedError,
    OverloadedError,
    PeerFaultError,
    PeerLostError,
)
from rce.protocol import Address, CallId, LargeData
from rce_robot.exceptions import BusyError, MisdirectedError, UnreadableError
from rce_robot.services import AnsweredByRobot


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


@pytest.mark.parametrize("large", [False, True])
def test_too_many_calls_are_refused(*, large: bool) -> None:
    """A large request is not read then: a coroutine that was made for it would be warned about."""
    setup = Setup("ServiceProviderConverter", SERVICE)
    setup.robot.room = False
    data = LargeData(Address("tag", SERVICE, "id1"), b"{}")
    with pytest.raises(BusyError, match="id1"):
        setup.interface.take_large(data) if large else setup.take({"data": True}, "id1")
    gc.collect()


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


def with_pictures(type_: str) -> Setup:
    """Return an interface whose messages are converted in another process."""
    setup = Setup(type_, SERVICE)
    setup.interface.form_in.costly = True
    return setup


def test_unreadable_request_of_a_costly_type_names_its_call() -> None:
    setup = with_pictures("ServiceProviderConverter")
    with pytest.raises(UnreadableError, match="longer than 64 bits") as caught:
        setup.take({"data": 2**64}, "id1")
    assert caught.value.call == CallId("tag", "id1")


async def begun_call(setup: Setup) -> tuple[asyncio.Future[Buffer], str]:
    """Call the robot's service; return the answer and the call's id."""
    call = asyncio.ensure_future(setup.interface.serve(b"\x01"))
    await asyncio.sleep(0)
    return call, shown(setup.robot.urgent[0])["msgID"]


async def test_unreadable_answer_of_a_costly_type_fails_its_call() -> None:
    setup = with_pictures("ServiceClientConverter")
    call, msg_id = await begun_call(setup)
    with pytest.raises(UnreadableError) as caught:
        setup.take({"success": 2**64}, msg_id)
    assert caught.value.call == CallId("tag", msg_id)
    with pytest.raises(PeerFaultError, match="longer than 64 bits"):
        await call


@pytest.mark.parametrize("large", [False, True])
async def test_answer_that_finds_no_room_fails_its_call(*, large: bool) -> None:
    setup = with_pictures("ServiceClientConverter")
    call, msg_id = await begun_call(setup)
    setup.robot.room = False
    data = LargeData(Address("tag", SERVICE, msg_id), b"{}")
    with pytest.raises(BusyError):
        setup.interface.take_large(data) if large else setup.take({"success": True}, msg_id)
    with pytest.raises(PeerFaultError, match="too much is converted already"):
        await call


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
