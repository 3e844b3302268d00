"""Tasks of the fleet manager, carried out by real planner, move clients and simulated robots."""

from __future__ import annotations

from pathlib import Path

from support.managed_fleet import managed_fleet


async def test_tasks_are_carried_out_by_robots(tmp_path: Path) -> None:
    """Two robots carry out a delivery, a patrol and a task that comes after them."""
    async with managed_fleet(tmp_path / "journal.sqlite", [0, 7]) as fleet:
        delivery = {
            "stops": [
                {"action": "pick", "cell": 18, "duration": 0.5},
                {"action": "deliver", "cells": [45, 46], "duration": 0.5},
            ]
        }
        made = await fleet.ask("POST", "/tasks", delivery, key="order-1")
        assert (made.status, made.body["id"], made.revision) == (201, "T1", '"1"')
        again = await fleet.ask("POST", "/tasks", delivery, key="order-1")
        assert (again.status, again.body["id"]) == (200, "T1")
        patrol = {"stops": [{"cell": 5}, {"cell": 21}], "rounds": 2}
        assert (await fleet.ask("POST", "/tasks", patrol)).body["id"] == "T2"
        last = {"stops": [{"cell": 63}], "after": ["T1", "T2"]}
        assert (await fleet.ask("POST", "/tasks", last)).body["id"] == "T3"
        done = await fleet.until_state("T3", "done")
        first = (await fleet.ask("GET", "/tasks/T1")).body
        second = (await fleet.ask("GET", "/tasks/T2")).body
        assert (first["state"], second["state"]) == ("done", "done")
        assert [visit["stop"] for visit in first["visits"]] == [0, 1]
        assert [visit["cell"] for visit in second["visits"]] == [5, 21, 5, 21]
        assert first["visits"][-1]["ended_at"] <= done["started_at"]
        assert fleet.world.collisions.total == 0
        page = (await fleet.ask("GET", "/tasks?state=done&limit=2")).body
        assert ([task["id"] for task in page["tasks"]], page["next"]) == (["T1", "T2"], "2")
        events = (await fleet.ask("GET", "/events?after=0")).body["events"]
        assert [event["number"] for event in events] == list(range(1, len(events) + 1))
        assert {event["name"] for event in fleet.events} >= {"created", "started", "arrived", "finished"}
        figures = (await fleet.ask("GET", "/statistics?seconds=600")).body
        assert figures["tasks_done"] == 3


async def test_a_robot_with_little_energy_is_dearer(tmp_path: Path) -> None:
    """Robot1 is 3 m nearer to the task, and the weight of energy is large."""
    weights = ("_energy_weight:=100000.0", "_fairness_weight:=0.0")
    async with managed_fleet(tmp_path / "journal.sqlite", [0, 7], parameters=weights) as fleet:
        await fleet.set_battery("Robot1", 0.3)
        await fleet.set_battery("Robot2", 0.9)
        task = (await fleet.ask("POST", "/tasks", {"stops": [{"cell": 2}]})).body["id"]
        done = await fleet.until_state(task, "done")
        assert [visit["robot"] for visit in done["visits"]] == ["Robot2"]
