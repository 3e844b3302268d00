"""Robots whose master sends what changed of their specs, and hears what changed of their statuses."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import pytest
from support.cloud import Cloud, running_cloud

from rce.control.messages import PatchSpec, StatusWanted, Sync
from rce.control.model import SpecPatch

from .conftest import Robot, dial

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

ROBOT = "testUser/testRobot"
STRING = "std_msgs/String"


@pytest.fixture
async def patching() -> AsyncIterator[Cloud]:
    async with running_cloud(in_patches=True) as cloud:
        yield cloud


async def test_interfaces_come_and_go_by_patches(patching: Cloud) -> None:
    async with dial(patching) as socket:
        robot = Robot(socket)
        for tag in ("one", "two", "three"):
            end = await patching.joined(tag, "SubscriberConverter", STRING)
            await robot.say(tag, STRING, {"data": tag})
            assert await end.received.get() == bytes([len(tag), 0, 0, 0]) + tag.encode()
        master = patching.master
        await master.changed.until(
            lambda: master.statuses[ROBOT].interfaces == dict.fromkeys(("one", "two", "three"), True)
        )
        assert master.statuses[ROBOT].connections == (1, 2, 3)
        spec = master.spec(ROBOT)
        master.put(
            ROBOT,
            interfaces=tuple(one for one in spec.interfaces if one.tag != "two"),
            connections=tuple(one for one in spec.connections if one.interface != "two"),
        )
        await master.changed.until(lambda: set(master.statuses[ROBOT].interfaces) == {"one", "three"})
        assert master.statuses[ROBOT].connections == (1, 3)
        assert not master.wanted, "every patch fitted"


async def test_a_patch_that_is_missing_is_made_up_for(patching: Cloud) -> None:
    master = patching.master
    async with dial(patching) as socket:
        robot = Robot(socket)
        await patching.joined("one", "SubscriberConverter", STRING)
        peer, master.peer = master.peer, None
        await patching.wire("two", "SubscriberConverter", STRING)  # of which the robot does not hear
        master.peer = peer
        end = await patching.joined("three", "SubscriberConverter", STRING)
        assert master.wanted == [ROBOT]
        await robot.say("three", STRING, {"data": "x"})
        assert await end.received.get() == b"\x01\0\0\0x"
        await patching.ends["testRobot_two"].until_active()


async def test_a_patch_for_an_unknown_robot_asks_for_its_spec(patching: Cloud) -> None:
    master = patching.master
    await master.changed.until(lambda: master.peer)
    assert master.peer is not None
    master.spec(ROBOT)
    master.inside.add(ROBOT)
    master.peer.send(PatchSpec(patch=SpecPatch(id=ROBOT, base=1, revision=2)))
    await master.changed.until(lambda: master.wanted == [ROBOT])
    await master.changed.until(lambda: ROBOT in master.statuses)


async def test_statuses_go_on_after_the_channel_broke_and_on_request(patching: Cloud) -> None:
    master = patching.master
    async with dial(patching):
        await patching.joined("one", "SubscriberConverter", STRING)
        await master.changed.until(lambda: master.statuses[ROBOT].connections == (1,))
        former = master.peer
        assert former is not None
        former.abort()
        await master.changed.until(lambda: master.peer not in (None, former))
        await patching.joined("two", "SubscriberConverter", STRING)
        await master.changed.until(lambda: master.statuses[ROBOT].connections == (1, 2))
        known = master.statuses.pop(ROBOT)
        assert master.peer is not None
        master.peer.send(StatusWanted(id=ROBOT))
        again = await master.changed.until(lambda: master.statuses.get(ROBOT))
        assert again.number > known.number
        assert (again.interfaces, again.connections) == (known.interfaces, known.connections)


async def test_a_sync_between_patches_is_the_new_base(patching: Cloud) -> None:
    master = patching.master
    async with dial(patching):
        await patching.joined("one", "SubscriberConverter", STRING)
        assert master.peer is not None
        peer, master.peer = master.peer, None
        await patching.wire("two", "SubscriberConverter", STRING)
        master.peer = peer
        peer.send(Sync(endpoints=(master.specs[ROBOT],)))
        await asyncio.gather(
            patching.joined("three", "SubscriberConverter", STRING),
            patching.ends["testRobot_two"].until_active(),
        )
        assert not master.wanted
