"""Planner and fleet manager are killed under load: no task is lost, none runs twice.

``make kills`` makes 20 kills instead of a few (``RCE_KILLS``), and prints the counts (``-s``).
"""

from __future__ import annotations

import asyncio
import os
import sys
from pathlib import Path
from typing import Any

import numpy as np
from support.managed_fleet import ManagedFleet, managed_fleet

KILLS = int(os.environ.get("RCE_KILLS", "4"))
PROGRAMS = ("fleet_manager.py", "fleet_planner.py")
AT_ONCE = 6
"""Tasks that are open at a time, at most."""


def delivery(number: int) -> dict[str, Any]:
    return {
        "stops": [
            {"action": "pick", "cells": [8 + number % 8, 16 + number % 8], "duration": 0.3},
            {"action": "deliver", "cells": [40 + number % 8, 48 + number % 8], "duration": 0.3},
        ]
    }


class Client:
    """Posts deliveries one after the other, as a client does that gets no answer: with the same key again."""

    def __init__(self, fleet: ManagedFleet) -> None:
        self.fleet = fleet
        self.accepted: dict[str, str] = {}
        """The task of each key."""
        self.zones: set[str] = set()

    async def run(self) -> None:
        """Post until the task is cancelled; sometimes a zone instead, in which robots are slow."""
        while True:
            page = (await self.fleet.ask("GET", "/tasks?state=open&limit=100")).body
            if len(page["tasks"]) < AT_ONCE:
                await self.post(len(self.accepted))
            if len(self.accepted) // 3 > len(self.zones):
                await self.make_zone(f"zone{len(self.zones)}")
            await asyncio.sleep(0.1)

    async def post(self, number: int) -> int:
        """Post an order; return the status: 200 if it was accepted before."""
        said = await self.fleet.ask("POST", "/tasks", delivery(number), key=f"order-{number}")
        assert said.status in (200, 201), said
        self.accepted[f"order-{number}"] = said.body["id"]
        return said.status

    async def make_zone(self, name: str) -> None:
        rule = {"kind": "slow", "cells": [len(self.zones)], "value": 0.5}
        said = await self.fleet.ask("PUT", f"/zones/{name}", rule)
        assert said.status in (200, 201), said
        self.zones.add(name)


async def kill_all(fleet: ManagedFleet, rng: np.random.Generator) -> list[str]:
    """Kill planner and manager in turn, at random times; return the victims."""
    victims = []
    for number in range(KILLS):
        victim = PROGRAMS[number % len(PROGRAMS)]
        await fleet.ask("GET", "/tasks?limit=1")  # a manager runs again
        await asyncio.sleep(float(rng.uniform(0.0, 1.5)))
        await fleet.kill(victim)
        await fleet.start(victim)
        victims.append(victim)
    return victims


async def test_kills_lose_no_task_and_repeat_none(tmp_path: Path) -> None:
    """Requests are accepted all the time; answers may be lost with the manager that gave them."""
    async with managed_fleet(tmp_path / "journal.sqlite", [0, 7], pace=6.0) as fleet:
        await fleet.ask("PUT", "/chargers", {"chargers": [63]})
        client = Client(fleet)
        posting = asyncio.create_task(client.run())
        victims = await kill_all(fleet, np.random.default_rng(7))
        posting.cancel()
        await asyncio.wait([posting])
        assert posting.cancelled(), posting.exception()
        before = dict(client.accepted)
        for number in range(len(before) + 1):  # what the last, cancelled, request left open too
            status = await client.post(number)
            assert status == 200 or f"order-{number}" not in before, f"order {number} was lost"
        assert before.items() <= client.accepted.items()
        assert len(set(client.accepted.values())) == len(client.accepted)
        for key, task in client.accepted.items():
            shown = await fleet.until_state(task, "done", "failed", "cancelled")
            assert (shown["state"], shown["key"]) == ("done", key), shown
            assert [visit["stop"] for visit in shown["visits"]] == [0, 1]
        events = (await fleet.ask("GET", "/events?after=0&limit=5000")).body["events"]
        assert [event["number"] for event in events] == list(range(1, len(events) + 1))
        ends = [event["id"] for event in events if event["name"] == "finished"]
        assert sorted(ends) == sorted(client.accepted.values())
        kept = (await fleet.ask("GET", "/zones")).body["zones"]
        assert client.zones <= {zone["id"] for zone in kept}
        assert (await fleet.ask("GET", "/chargers")).body["chargers"] == [63]
        assert fleet.world.collisions.total == 0
        sys.stdout.write(
            f"\n{len(victims)} kills, {len(client.accepted)} tasks accepted, {len(ends)} done once,"
            f" {len(client.zones)} zones, {fleet.world.collisions.total} contacts\n"
        )
