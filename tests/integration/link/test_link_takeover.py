"""A peer that is moved: its copy's link is made beside the present one, and takes over at one point."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import msgspec
import pytest
from msgspec.structs import replace
from support.link_kinds import SERVICE_OUT, TOPIC_IN, TOPIC_OUT

from rce.control.model import LinkAddress, LinkSpec
from rce.link import LinkLostError, LinkRefusedError
from rce.link.frames import Frame, FrameType, encode
from rce.link.handshake import LATCH, Welcome

if TYPE_CHECKING:
    from .conftest import Party, Rig

ENDS = [TOPIC_OUT, TOPIC_IN, SERVICE_OUT]
ALL = (1, 2, 3)


class Move:
    """A robot whose peer ``former`` is being moved: ``copy`` is linked to it, and silent."""

    def __init__(self, robot: Party, former: Party, copy: Party) -> None:
        self.robot, self.former, self.copy = robot, former, copy

    async def begin(self, *, robot_dials: bool) -> None:
        """Link the copy."""
        (link,) = self.robot.spec.links
        if robot_dials:
            await self.robot.apply(links=[replace(link, next=self.copy.address)])
        (end,) = self.former.spec.links
        interfaces = {one.tag: one.type for one in self.former.spec.interfaces}
        await self.copy.apply(interfaces, [replace(end, copy=True)], list(self.former.spec.connections))
        await self.copy.connected(*ALL)

    async def take_over(self) -> None:
        """Let the copy be the endpoint; as the master does, tell it and the robot."""
        (end,) = self.copy.spec.links
        await self.copy.apply(links=[replace(end, copy=False)])
        (link,) = self.robot.spec.links
        if link.dial:
            await self.robot.apply(links=[replace(link, address=self.copy.address, next=None)])


@pytest.fixture(params=["robot-dials", "peer-dials"])
def robot_dials(request: pytest.FixtureRequest) -> bool:
    return str(request.param) == "robot-dials"


@pytest.fixture(params=["unix", "tcp", "secure", "handed-over"])
def way(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture
async def move(rig: Rig, way: str, *, robot_dials: bool) -> Move:
    dialing, accepting = await rig.pair(way, quiet=0.1, take=1.0)
    robot, former = (dialing, accepting) if robot_dials else (accepting, dialing)
    copy = rig.party(former.spec.id.partition("/")[2], await rig.hub())
    if robot_dials:
        await rig.listen(copy, way)
        await rig.join(robot, former, ENDS)
    else:
        await rig.join(former, robot, [(there, here) for here, there in ENDS])
    await robot.connected(*ALL)
    await former.connected(*ALL)
    return Move(robot, former, copy)


async def test_takeover_loses_nothing(move: Move, *, robot_dials: bool) -> None:
    """Calls are answered where they came in, messages go to one place each, and no interface is inactive."""
    robot, former, copy = move.robot, move.former, move.copy
    await move.begin(robot_dials=robot_dials)
    copy.fakes["i2"].port.send(b"the copy is silent")
    robot.fakes["i1"].port.send(b"to the former")
    answers = asyncio.Event()

    async def late(payload: bytes) -> bytes:
        await answers.wait()
        return b"former " + payload

    former.fakes["i3"].answer = late
    call = asyncio.create_task(robot.fakes["i3"].port.call(b"call"))
    await former.fakes["i3"].asked.wait()
    await move.take_over()
    copy.fakes["i2"].port.send(b"from the new place")
    assert await robot.fakes["i2"].received.get() == (b"from the new place", False)
    former.fakes["i2"].port.send(b"a last word")
    assert await robot.fakes["i2"].received.get() == (b"a last word", False)
    robot.fakes["i1"].port.send(b"to the new place")
    assert await copy.fakes["i1"].received.get() == (b"to the new place", False)
    assert await former.fakes["i1"].received.get() == (b"to the former", False)
    assert await robot.fakes["i3"].port.call(b"new") == b"NEW"
    assert former.endpoint.connections == ALL, "a call is still under way there"
    answers.set()
    assert await call == b"former call"
    await former.connected()
    assert former.fakes["i1"].received.empty()
    assert robot.endpoint.connections == ALL
    assert [robot.fakes[tag].active for tag in ("i1", "i2", "i3")] == [[True]] * 3


@pytest.mark.parametrize("robot_dials", [False], ids=["peer-dials"])
@pytest.mark.parametrize("is_told_first", [True, False])
async def test_former_place_is_refused_after_the_takeover(
    move: Move, *, robot_dials: bool, is_told_first: bool
) -> None:
    """The accepting end hears of the new place from the master before the copy takes over, or after."""
    robot, former, copy = move.robot, move.former, move.copy
    (end,) = former.spec.links
    await former.apply(links=[replace(end, epoch=1)])
    await move.begin(robot_dials=robot_dials)
    (own,), (accepting,) = copy.spec.links, robot.spec.links
    await copy.apply(links=[replace(own, epoch=2)])

    async def tell() -> None:
        await robot.apply(links=[replace(accepting, peer_epoch=2)])

    if is_told_first:
        await tell()
    await move.take_over()
    copy.fakes["i2"].port.send(b"from the new place")
    await robot.fakes["i2"].received.get()
    if not is_told_first:
        await tell()
    await former.connected()
    with pytest.raises(LinkRefusedError, match="the endpoint is somewhere else now"):
        await former.hub.connect(former.spec.links[0])
    assert await robot.fakes["i3"].port.call(b"still there") == b"STILL THERE"


async def test_latched_messages_reach_the_new_place(move: Move, *, robot_dials: bool) -> None:
    """Those of the robot come to the copy when it takes over, and those of the copy to the robot."""
    robot, copy = move.robot, move.copy
    robot.fakes["i1"].port.send(b"robot's map", latched=True)
    move.former.fakes["i2"].port.send(b"former map", latched=True)
    await robot.fakes["i2"].until_latched(b"former map")
    await move.begin(robot_dials=robot_dials)
    copy.fakes["i2"].port.send(b"new map", latched=True)
    assert not copy.fakes["i1"].latched
    await move.take_over()
    await copy.fakes["i1"].until_latched(b"robot's map")
    await robot.fakes["i2"].until_latched(b"new map")


async def test_copy_that_dies_changes_nothing(move: Move, *, robot_dials: bool) -> None:
    """The link to the former place continues."""
    robot, former = move.robot, move.former
    await move.begin(robot_dials=robot_dials)
    await move.copy.endpoint.close()
    (link,) = robot.spec.links
    await robot.apply(links=[replace(link, next=None)])
    robot.fakes["i1"].port.send(b"still here")
    assert await former.fakes["i1"].received.get() == (b"still here", False)
    assert robot.fakes["i1"].active == [True]


async def test_former_place_dies_before_the_takeover(move: Move, *, robot_dials: bool) -> None:
    """The copy takes over: at once where the robot dials, else when the copy says so."""
    robot, copy = move.robot, move.copy
    await move.begin(robot_dials=robot_dials)
    await move.former.endpoint.close()
    await move.take_over()
    await robot.connected(*ALL)
    assert await robot.fakes["i3"].port.call(b"new") == b"NEW"
    robot.fakes["i1"].port.send(b"to the new place")
    assert await copy.fakes["i1"].received.get() == (b"to the new place", False)


async def test_connections_change_while_a_copy_is_linked(move: Move, *, robot_dials: bool) -> None:
    """One that is removed is removed beside it too; the others are taken over."""
    robot, copy = move.robot, move.copy
    await move.begin(robot_dials=robot_dials)
    for party in (robot, move.former, copy):
        await party.apply(connections=[one for one in party.spec.connections if one.id != 1])
    await copy.connected(2, 3)
    await move.take_over()
    assert await robot.fakes["i3"].port.call(b"new") == b"NEW"
    await move.former.connected()
    assert robot.endpoint.connections == (2, 3)


async def test_robot_that_links_late_changes_at_once(rig: Rig) -> None:
    """The copy has taken over before the robot reached it."""
    robot, former = await rig.pair("unix", quiet=0.1)
    copy = rig.party("b", await rig.hub())
    await rig.listen(copy, "unix")
    await rig.join(robot, former, ENDS)
    await robot.connected(*ALL)
    interfaces = {one.tag: one.type for one in former.spec.interfaces}
    end = LinkSpec(id="L", peer=robot.spec.id, token="secret", dial=False, address=LinkAddress())
    await copy.apply(interfaces, [replace(end, copy=True)], list(former.spec.connections))
    await copy.apply(links=[end])
    (link,) = robot.spec.links
    await robot.apply(links=[replace(link, next=copy.address)])
    await copy.connected(*ALL)
    await former.connected()
    assert await robot.fakes["i3"].port.call(b"new") == b"NEW"
    assert robot.fakes["i3"].active == [True]


@pytest.mark.parametrize("robot_dials", [True], ids=["robot-dials"])
async def test_copy_of_an_earlier_release_is_dialed_in_the_end(
    move: Move, monkeypatch: pytest.MonkeyPatch, *, robot_dials: bool
) -> None:
    """It cannot stand by: the robot gives that up at first, and dials it again when it took over."""
    robot, former, copy = move.robot, move.former, move.copy
    greeted = asyncio.Event()

    def welcome() -> bytes:
        greeted.set()
        payload = msgspec.json.encode(Welcome(features=(LATCH,)))
        return encode(Frame(FrameType.WELCOME, payload=payload))

    monkeypatch.setattr("rce.link.hub.encode_welcome", welcome)
    (end,), (link,) = former.spec.links, robot.spec.links
    interfaces = {one.tag: one.type for one in former.spec.interfaces}
    await copy.apply(interfaces, [replace(end, copy=True)], list(former.spec.connections))
    await robot.apply(links=[replace(link, next=copy.address)])
    await greeted.wait()
    async with asyncio.timeout(60):
        while copy.hub._carriers:
            await asyncio.sleep(0.01)
    assert robot.fakes["i3"].active == [True]
    await move.take_over()
    await copy.connected(*ALL)
    await robot.connected(*ALL)
    assert await robot.fakes["i3"].port.call(b"new") == b"NEW"
    assert copy.fakes["i3"].asked.is_set()
    robot.fakes["i1"].port.send(b"to the new place")
    assert await copy.fakes["i1"].received.get() == (b"to the new place", False)


async def test_links_that_break_before_the_takeover_are_made_again(move: Move, *, robot_dials: bool) -> None:
    """The robot's connections to both places are torn: each place keeps its part."""
    robot, former, copy = move.robot, move.former, move.copy
    await move.begin(robot_dials=robot_dials)
    for carrier in list(robot.hub._carriers):
        carrier.abort(LinkLostError("torn by the test"))
    await robot.until(lambda: robot.fakes["i3"].active == [True, False, True])
    await robot.connected(*ALL)
    await copy.until(lambda: copy.fakes["i3"].active == [True, False, True])
    await copy.connected(*ALL)
    assert await robot.fakes["i3"].port.call(b"call") == b"CALL"
    assert former.fakes["i3"].asked.is_set()
    assert not copy.fakes["i3"].asked.is_set()
    await move.take_over()
    await former.connected()
    assert await robot.fakes["i3"].port.call(b"new") == b"NEW"
    assert copy.fakes["i3"].asked.is_set()


async def test_both_ends_are_moved_one_after_the_other(rig: Rig) -> None:
    """The second move's copy is silent until it takes over, also if only calls came from its end before."""
    one, other = await rig.pair("unix", quiet=0.1, take=1.0)
    moved, moved_later = rig.party("b", await rig.hub()), rig.party("a", await rig.hub())
    await rig.listen(moved, "unix")
    await rig.join(one, other, ENDS)
    await one.connected(*ALL)
    first, second = Move(one, other, moved), Move(moved, one, moved_later)
    await first.begin(robot_dials=True)
    await first.take_over()
    await other.connected()
    assert await one.fakes["i3"].port.call(b"call") == b"CALL"
    await second.begin(robot_dials=False)
    assert await one.fakes["i3"].port.call(b"still") == b"STILL"
    assert one.fakes["i3"].active == [True]
    await second.take_over()
    assert await moved_later.fakes["i3"].port.call(b"new") == b"NEW"
    moved.fakes["i2"].port.send(b"to the new place")
    assert await moved_later.fakes["i2"].received.get() == (b"to the new place", False)
    await one.connected()
    assert moved.endpoint.connections == ALL
