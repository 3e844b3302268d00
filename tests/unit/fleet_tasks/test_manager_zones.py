"""Zones between the fleet manager, its journal and the planner."""

from __future__ import annotations

from typing import Any

import pytest
from support.fleet_manager import ManagerClient

from rce_fleet.manager.mirror import REFUSED_S
from rce_fleet.planning.grid import GridMap
from rce_fleet.tasks.records import PlannerRun, Zone


@pytest.mark.parametrize(
    ("zone", "status", "text"),
    [
        ({"kind": "fast", "value": 1.0}, 422, "'slow', 'one_way', 'limited' or 'cost'"),
        ({"kind": "slow"}, 409, "needs a value"),
        ({"kind": "slow", "value": 0.0}, 409, "a speed of 0.01 .. 100 m/s"),
        ({"kind": "one_way", "value": 0.8}, 409, "a direction is 0, pi/2, pi or -pi/2"),
        ({"kind": "room", "value": 1.5}, 409, "whole number"),
        ({"kind": "room", "value": 0}, 409, "within 1 .. 1000000"),
        ({"kind": "cost", "value": -1}, 409, "a metre counts 1 .. 1000000"),
    ],
)
async def test_zones_that_cannot_be(client: ManagerClient, zone: Any, status: int, text: str) -> None:
    said, answer, _ = await client.ask("PUT", "/zones/z", {"cells": [3], **zone})
    assert (said, text in answer["error"]) == (status, True), answer


async def test_moves_are_closed_for_single_robots(client: ManagerClient) -> None:
    """Also by the direction of an aisle."""
    for body in (
        {"kind": "blocked", "edges": [[3, 4]], "robots": ["Robot1"]},
        {"kind": "one_way", "cells": [3, 4], "value": 0.0, "robots": ["Robot1"]},
    ):
        status, made, _ = await client.ask("PUT", "/zones/own", body)
        assert (status in (200, 201), made["robots"]) == (True, ["Robot1"])


async def test_former_words_of_zones_are_understood(client: ManagerClient) -> None:
    body = {"kind": "room", "cells": [3], "value": 2}
    assert (await client.ask("PUT", "/zones/lift", body))[1]["kind"] == "limited"


async def test_zones_reach_the_planner(client: ManagerClient) -> None:
    """Also when it was away."""
    manager, planner = client.manager, client.planner
    manager.facts.is_current = True
    manager.planner_began(PlannerRun("1", "8 x 8"))
    planner.refusal = "the planner does not answer"
    slow = {"kind": "slow", "cells": [3, 4], "value": 0.2, "until": manager.clock() + 1000}
    assert (await client.ask("PUT", "/zones/aisle", slow))[0] == 201
    assert (await client.ask("PUT", "/zones/dear", {"kind": "cost", "cells": [6], "value": 2.0}))[0] == 201
    planner.refusal = ""
    planner.calls.clear()
    await manager.step()
    assert planner.calls == [], "it was sent again at once"
    manager.clock._now += REFUSED_S  # type: ignore[attr-defined]  # the clock is moved on
    await manager.step()
    assert planner.calls == [("zone", "aisle", "slow"), ("zone", "dear", "cost")]
    manager.facts.zones |= manager.book.zones
    manager.clock._now += 1000.0  # type: ignore[attr-defined]
    await manager.step()
    assert planner.calls[-1] == ("zone", "aisle", None)
    assert [zone["id"] for zone in (await client.ask("GET", "/zones"))[1]["zones"]] == ["dear"]


@pytest.mark.parametrize("zone", [{"kind": "blocked"}, {"kind": "cost", "value": 2.0}])
async def test_a_removed_zone_leaves_the_journal(client: ManagerClient, zone: dict[str, Any]) -> None:
    """Once the planner has confirmed it; what happened to it stays among the events."""
    manager, planner = client.manager, client.planner
    manager.facts.is_current = True
    manager.planner_began(PlannerRun("1", "8 x 8"))
    await client.ask("PUT", "/zones/z", {**zone, "cells": [3]})
    manager.facts.zones["z"] = manager.book.zones["z"]
    await manager.step()
    assert [record for record in client.journal.load()[0] if isinstance(record, Zone)]
    planner.refusal = "the planner does not answer"
    assert (await client.ask("DELETE", "/zones/z"))[0] == 200
    kept = [record for record in client.journal.load()[0] if isinstance(record, Zone)]
    assert [record.is_removed for record in kept] == [True]
    manager.facts.zones.clear()
    planner.refusal = ""
    manager.clock._now += REFUSED_S  # type: ignore[attr-defined]  # the clock is moved on
    for _ in range(2):
        await manager.step()
    assert not [record for record in client.journal.load()[0] if isinstance(record, Zone)]
    events = (await client.ask("GET", "/events?id=z"))[1]["events"]
    assert [event["name"] for event in events] == ["zone", "zone removed"]


async def test_a_zone_that_the_planner_refuses_is_not_made(client: ManagerClient) -> None:
    """A changed one is as it was before; the answer says why."""
    manager, planner = client.manager, client.planner
    manager.facts.is_current = True
    manager.planner_began(PlannerRun("1", "8 x 8"))
    cost = {"kind": "cost", "cells": [6], "value": 2.0}
    assert (await client.ask("PUT", "/zones/kept", cost))[0] == 201
    manager.facts.zones["kept"] = kept = manager.book.zones["kept"]
    planner.refusal = "zone: not on the map"
    for name in ("new", "kept"):
        status, said, _ = await client.ask("PUT", f"/zones/{name}", {**cost, "cells": [7]})
        assert (status, said) == (409, {"error": "zone: not on the map"})
    assert [zone["id"] for zone in (await client.ask("GET", "/zones"))[1]["zones"]] == ["kept"]
    assert manager.book.zones["kept"].cells == kept.cells
    assert manager.book.zones["kept"].revision > kept.revision + 1
    planner.calls.clear()
    planner.refusal = ""
    for _ in range(2):
        manager.clock._now += REFUSED_S  # type: ignore[attr-defined]  # the clock is moved on
        await manager.step()
    assert planner.calls == []
    assert (await client.ask("PUT", "/zones/new", cost))[0] == 201


async def test_a_zone_off_a_map_not_known_yet_is_undone(client: ManagerClient) -> None:
    """The planner was not heard yet when it was accepted; an event says why it is not there."""
    manager, planner = client.manager, client.planner
    manager.facts.grid = manager.book.grid = None
    manager.facts.is_live = False
    cost = {"kind": "cost", "cells": [6], "value": 2.0}
    assert (await client.ask("PUT", "/zones/far", {**cost, "cells": [5000]}))[0] == 201
    manager.facts.grid, manager.facts.is_live, manager.facts.is_current = GridMap(), True, True
    manager.planner_began(PlannerRun("1", "8 x 8"))
    planner.refusal = "zone: cells [5000] are not on the map"
    for _ in range(2):
        await manager.step()
    assert (await client.ask("GET", "/zones"))[1]["zones"] == []
    events = (await client.ask("GET", "/events?id=far"))[1]["events"]
    assert [event["name"] for event in events] == ["zone", "refused"]
    assert planner.refusal in events[-1]["text"]
    assert not [record for record in client.journal.load()[0] if isinstance(record, Zone)]


async def test_a_confirmed_zone_refused_later_stays(client: ManagerClient) -> None:
    """A planner of an earlier release may not know its kind."""
    manager, planner = client.manager, client.planner
    manager.facts.is_current = True
    manager.planner_began(PlannerRun("1", "8 x 8"))
    await client.ask("PUT", "/zones/dear", {"kind": "cost", "cells": [6], "value": 2.0})
    manager.facts.zones |= manager.book.zones
    await manager.step()
    manager.facts.zones.clear()
    planner.refusal = "zone: kind must be one of blocked, slow"
    manager.planner_began(PlannerRun("2", "8 x 8"))
    await manager.step()
    assert planner.calls[-1] == ("zone", "dear", "cost")
    assert set(manager.book.zones) == {"dear"}
