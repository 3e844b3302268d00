"""Who blocked cells, and why, as the fleet manager keeps and shows it; restarts of manager and planner."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import msgspec
import pytest
from support.fleet_manager import ManagerClient
from support.planner_copy import RUN, Both

from rce.ros.types import Time
from rce_fleet.coordination.events import CellBlocked, CellFreed, ObstacleSeen, PoseSeen
from rce_fleet.coordination.planner import FleetPlanner
from rce_fleet.manager.cell_blocks import block_request, read_block
from rce_fleet.manager.planner_sync import CELLS_DELAY_S, BlockCell
from rce_fleet.nodes.fleet_facts import FactKeeper
from rce_fleet.nodes.state_publisher import changes_fields, fleet_fields, state_fields
from rce_fleet.planning.grid import GridMap
from rce_fleet.tasks.book import TaskBook
from rce_fleet.tasks.clamping import clamped
from rce_fleet.tasks.facts import FleetFacts
from rce_fleet.tasks.records import BlockedCells, CellBlock, PlannerRun

if TYPE_CHECKING:
    from pathlib import Path

SPILL = CellBlock("ann", "spill", 990.0, 1100.0)
LATER = replace(SPILL, until=2000.0)


async def test_the_map_shows_who_blocked_a_cell(client: ManagerClient) -> None:
    """Cells of people and of sensors; the list of blocked cells stays as it was."""
    manager = client.manager
    began = manager.clock()
    spill = {"blocked": True, "reason": "spill", "until": began + 600.0}
    assert (await client.ask("PUT", "/cells/5", spill))[0] == 200
    manager.facts.shut = frozenset({9, 12})
    manager.facts.blocks[12] = CellBlock(reason="", since=7.0, robot="Robot3")
    shown = (await client.ask("GET", "/map"))[1]
    assert shown["blocked"] == [5, 12]
    people, sensor = shown["blocks"]
    assert began <= people.pop("since") <= manager.clock()
    assert people == {"cell": 5, "user": "erp", "robot": "", "reason": "spill", "until": began + 600.0}
    assert sensor == {"cell": 12, "user": "", "robot": "Robot3", "reason": "", "since": 7.0, "until": None}
    assert (await client.ask("GET", "/events"))[1]["events"][-1]["text"] == "cell 5 is blocked: spill"
    manager.clock._now += 600.0  # type: ignore[attr-defined]  # the clock is moved on
    shown = (await client.ask("GET", "/map"))[1]
    assert (shown["blocked"], [block["cell"] for block in shown["blocks"]]) == ([12], [12])


async def test_the_newest_request_counts(client: ManagerClient) -> None:
    """The same one again changes nothing; one without a reason is as it always was."""
    first = {"blocked": True, "reason": "spill"}
    for user, asked in (("ann", first), ("bob", first), ("bob", {"blocked": True})):
        assert (await client.ask("PUT", "/cells/5", asked, user=user))[0] == 200
    sent = [(one["by"], one["reason"], one["lifetime"]) for one in client.planner.requests]
    assert sent == [("ann", "spill", 0.0), ("ann", "spill", 0.0), ("bob", "", 0.0)]
    told = [event["user"] for event in (await client.ask("GET", "/events"))[1]["events"]]
    assert told == ["ann", "bob"]
    block = client.manager.book.blocked.block(5)
    assert (block.user, block.reason, block.until) == ("bob", "", None)


async def test_a_refused_reason_leaves_the_one_before(client: ManagerClient) -> None:
    assert (await client.ask("PUT", "/cells/5", {"blocked": True, "reason": "spill"}))[0] == 200
    client.planner.refusal = "no"
    assert (await client.ask("PUT", "/cells/5", {"blocked": True, "reason": "oil"}))[0] == 409
    assert client.manager.book.blocked.block(5).reason == "spill"
    late = {"blocked": True, "until": client.manager.clock() - 1.0}
    status, said, _ = await client.ask("PUT", "/cells/5", late)
    assert (status, "is not after now" in said["error"]) == (409, True)


async def test_a_restarted_manager_tells_a_new_planner_why(tmp_path: Path) -> None:
    """Both were killed: user, reason, and what is left of the time are in the journal."""
    first = ManagerClient(tmp_path / "j.sqlite")
    until = first.manager.clock() + 600.0
    await first.ask("PUT", "/cells/5", {"blocked": True, "reason": "spill", "until": until})
    await first.manager.close()
    second = ManagerClient(tmp_path / "j.sqlite")
    second.manager.facts.is_current = True
    second.manager.planner_began(PlannerRun("2", "8 x 8"))
    await second.manager.step()
    (sent,) = second.planner.requests
    assert (sent["cell"], sent["by"], sent["reason"]) == (5, "erp", "spill")
    assert (sent["age"] >= 0.0, 0.0 < sent["lifetime"] <= 600.0) == (True, True)
    await second.manager.close()


def test_journals_of_earlier_releases_are_read() -> None:
    known = msgspec.json.decode(b'{"cells":[7],"unsent":[]}', type=BlockedCells)
    assert (known.cells, known.block(7)) == ((7,), CellBlock())
    kept = BlockedCells((7,), (), {7: SPILL})
    assert msgspec.json.decode(msgspec.json.encode(kept), type=BlockedCells) == kept
    far = BlockedCells((7,), (), {7: replace(SPILL, until=1e300), 2**40: SPILL})
    assert clamped(far) == BlockedCells((7,), (), {7: replace(SPILL, until=1e11)})


def test_messages_have_times_from_now_on() -> None:
    asked = block_request(5, SPILL, 1000.0)
    assert asked == {
        "cell": 5,
        "blocked": True,
        "reason": "spill",
        "by": "ann",
        "age": 10.0,
        "lifetime": 100.0,
    }
    assert block_request(5, SPILL, 1200.0)["lifetime"] > 0, "0: it stays blocked"
    assert block_request(5, None, 1000.0) == {"cell": 5, "blocked": False}
    assert read_block({**asked, "sensed": False}, 1000.0) == SPILL


def test_facts_have_who_blocked_cells() -> None:
    """Of complete states and of changes; planners of earlier releases tell nothing."""
    planner, facts = FleetPlanner(GridMap()), FleetFacts()
    keeper, started = FactKeeper(facts), {"secs": 5, "nsecs": 0}
    planner.handle(PoseSeen("Robot3", 0.5, 0.5, 0.0), 5.0)
    planner.handle(CellBlocked(5, "ann", "spill", expires=110.0), 10.0)
    planner.take_changes()
    state = {**state_fields(Time(5, 0), planner, 20.0), "started": started}
    keeper.take_state({"sequence": planner.sequence, "state": state}, 1000.0)
    assert facts.blocks == {5: replace(SPILL, until=1090.0)}
    planner.handle(CellFreed(5), 20.0)
    planner.handle(ObstacleSeen("Robot3", (6,)), 20.0)
    fields = changes_fields(Time(5, 0), planner.take_changes(), planner.sequence, 20.0)
    keeper.take_changes({**fields, **fleet_fields(planner), "started": started}, 1000.0)
    assert facts.blocks == {6: CellBlock(since=1000.0, robot="Robot3")}
    earlier: dict[str, Any] = {**state, "started": {"secs": 6, "nsecs": 0}}
    del earlier["blocks"]
    keeper.take_state({"sequence": 0, "state": earlier}, 1000.0)
    assert facts.blocks == {}


def blocked(both: Both, block: CellBlock, *, unsent: bool = False) -> None:
    """Block cell 9 in the book."""
    made = both.book.blocked.changed({9: True}, unsent=unsent, blocks={9: block})
    both.book.emit(made, "blocked", both.now)


def texts(book: TaskBook) -> list[str]:
    return [event.text for event in book.take_events()]


def test_what_was_blocked_at_the_planner_has_its_reason() -> None:
    """Also a reason or an end that is changed there later."""
    both = Both()
    both.facts.requested, both.facts.blocks[9] = frozenset({9}), SPILL
    assert both.step() == []
    assert both.book.blocked == BlockedCells((9,), (), {9: SPILL})
    assert [event.user for event in both.book.take_events() if event.kind == "cells"] == ["ann"]
    for other in (LATER, replace(LATER, reason="oil", user="bob")):
        both.facts.blocks[9] = other
        assert (both.step(), both.book.blocked.block(9)) == ([], other)
    both.facts.blocks[9] = replace(LATER, reason="oil", user="bob", since=991.0, until=2001.0)
    texts(both.book)
    assert (both.step(), texts(both.book)) == ([], []), "messages take some time"


def test_a_reason_set_by_a_request_is_sent() -> None:
    """The planner's state before it does not undo it, nor a silence of the planner meanwhile."""
    both = Both()
    blocked(both, SPILL, unsent=True)
    assert both.step() == [BlockCell(9, True, SPILL)]
    assert both.confirm() == 1
    both.facts.is_live = False
    blocked(both, LATER, unsent=True)
    assert (both.step(), both.confirm()) == ([], 0)
    both.facts.is_live = True
    both.sync.adopt(both.now)
    assert both.book.blocked.block(9) == LATER
    assert both.step() == [BlockCell(9, True, LATER)]
    both.facts.blocks[9] = SPILL
    assert (both.confirm(), both.step(1.0), both.book.blocked.block(9)) == (1, [], LATER)


def test_a_cell_is_free_when_the_planner_ended_its_block() -> None:
    both = Both()
    blocked(both, SPILL)
    both.step()
    texts(both.book)
    both.facts.requested, both.facts.blocks = frozenset(), {}
    assert (both.step(200.0), both.book.blocked.cells) == ([], ())
    assert texts(both.book) == ["the time of blocked cells has ended: 9"]


@pytest.mark.parametrize("prolonged", [False, True])
def test_a_block_ends_while_the_planner_is_silent(prolonged: bool) -> None:
    """Unless it was prolonged there: the planner tells when it is heard again."""
    both = Both()
    blocked(both, SPILL)
    both.step()
    both.facts.is_live = False
    both.step(1100.0 - both.now)
    assert set(both.book.blocked.cells) == {9}
    both.step(CELLS_DELAY_S)
    assert not set(both.book.blocked.cells)
    both.facts.is_live = True
    both.facts.requested = frozenset({9} if prolonged else ())
    both.facts.blocks = {9: LATER} if prolonged else {}
    assert both.step() == []
    assert both.book.blocked == (BlockedCells((9,), (), {9: LATER}) if prolonged else BlockedCells())


def test_a_restarted_planner_gets_users_and_reasons() -> None:
    """Also where its parameters block the cell for another reason."""
    both = Both()
    blocked(both, LATER)
    both.step()
    both.facts.blocks = {9: CellBlock(reason="parameter of the planner", since=1000.0)}
    both.sync.begin(replace(RUN, started="2.0"), both.now)
    assert both.step() == [BlockCell(9, True, LATER)]
    assert both.book.blocked.block(9) == LATER
