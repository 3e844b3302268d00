"""A robot's program that knows all masters, when the leading one and its own robot task set are killed."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.engine import until
from support.etcd import cluster
from support.masters import DEV_USER, masters
from support.replicated import TIMEOUT_S, Caller, task_sets

from rce_client import Connection, State

pytestmark = [pytest.mark.e2e, pytest.mark.needs("etcd"), pytest.mark.timeout(600)]


async def test_connection_finds_the_next_leader(folder: Path) -> None:
    """Its first URL is the one of the killed leader. What it asks for meanwhile is done."""
    states: list[State] = []
    async with (
        cluster(folder / "etcd", 3) as etcd,
        masters(folder / "masters", etcd.store) as all_,
        task_sets(folder, all_, robots=1) as (robots, _),
    ):
        leader = await all_.leader()
        urls = [leader.url, *(master.url for master in all_.all if master is not leader)]

        def note(state: State, _: str) -> None:
            states.append(state)

        async with (
            Connection(urls, DEV_USER, DEV_USER, "robot", on_state=note) as robot,
            Caller.calling(robot) as caller,
        ):
            await caller.wait_for_answers()
            await leader.kill()
            await caller.wait_for_answers()
            assert State.LOST not in states, "the change of the leader broke a connection"
            await robots.kill()
            await robot.create_container("meanwhile")
            await robots.start()
            await all_.leader(but=leader)
            await caller.wait_for_answers()
            assert State.RESTORED in states
            async with all_.session() as session:

                async def is_made() -> bool:
                    other = next(master for master in all_.all if master is not leader)
                    async with session.get(f"{other.url}api/v1/containers") as reply:
                        found = (await reply.json()).get("containers", [])
                    return "meanwhile" in {container["tag"] for container in found}

                await until(is_made, timeout=TIMEOUT_S, what="the container is made")
            await robot.remove_all()


async def test_a_robot_connects_through_a_stand_by(folder: Path) -> None:
    """It knows the address of a stand-by only, which has the leading master hand the endpoint out."""
    async with (
        cluster(folder / "etcd", 1) as etcd,
        masters(folder / "masters", etcd.store, count=2, lease=20.0) as all_,
        task_sets(folder, all_, robots=1),
    ):
        leader = await all_.leader()
        (standby,) = (master for master in all_.all if master is not leader)
        async with (
            Connection(standby.url, DEV_USER, DEV_USER, "robot") as robot,
            Caller.calling(robot) as caller,
        ):
            await caller.wait_for_answers()
            await robot.remove_all()
        assert (await standby.health())["role"] == "standby", "the lead changed: it was no stand-by"
