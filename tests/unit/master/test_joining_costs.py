"""What a robot costs when it joins a container does not grow with those that joined before."""

from __future__ import annotations

import msgspec
import pytest
from support.master_world import World

from rce_master.exceptions import LimitReachedError
from rce_master.state.changes import Changes
from rce_master.state.settings import StateSettings

ROBOTS = 120
TOPICS = 6


def join(world: World, robot: str) -> list[Changes]:
    """Let a robot log in and join six of its interfaces with six of the container's."""
    done = [world.login(robot)]
    for topic in range(TOPICS):
        done.append(world.interface(f"{robot}/t{topic}", "SubscriberConverter"))
        done.append(world.interface(f"c/{robot}_t{topic}", "PublisherInterface"))
        done.append(world.connect(f"{robot}/t{topic}", f"c/{robot}_t{topic}"))
    return done


def stored(done: list[Changes]) -> int:
    return sum(len(row.body or b"") for changes in done for row in changes.rows())


def sent(world: World, done: list[Changes]) -> int:
    """Bytes of the patches to all task sets."""
    return sum(
        len(msgspec.json.encode(world.state.patch(id_, touched)))
        for changes in done
        for id_, touched in changes.touched.items()
    )


def test_bytes_stored_and_sent_for_a_robot_stay_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    world = World()
    world.robot_set()
    world.container_set()
    world.container()
    first = join(world, "robot100")
    costs = stored(first), sent(world, first)
    # The invariants are checked after every command, which takes the longer the more there is.
    monkeypatch.setattr(world.state, "validate", lambda: None)
    for number in range(1, ROBOTS):
        last = join(world, f"robot{100 + number}")
    monkeypatch.undo()
    world.state.validate()
    assert stored(last) <= 1.1 * costs[0], "only numbers grow by a digit or two"
    assert sent(world, last) <= 1.1 * costs[1]
    assert len(world.spec("c").interfaces) == ROBOTS * TOPICS


def test_users_have_so_many_interfaces_and_connections_in_all() -> None:
    world = World(StateSettings(max_user_interfaces=3, max_user_connections=1))
    world.wired()
    world.interface("rob/more", "SubscriberConverter")
    with pytest.raises(LimitReachedError, match="you have 3 interfaces already"):
        world.interface("c/more", "PublisherInterface")
    with pytest.raises(LimitReachedError, match="you have 1 connections already"):
        world.connect("rob/more", "c/in")
