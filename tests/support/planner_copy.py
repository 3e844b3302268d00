"""A journal's book and a planner beside each other, which the manager's comparison keeps the same."""

from __future__ import annotations

from rce_fleet.manager.planner_sync import BlockCell, PlannerCall, PlannerSync, SetCosts, SetMode
from rce_fleet.manager.zones import read_zone, zone_fields
from rce_fleet.tasks.book import TaskBook
from rce_fleet.tasks.facts import FleetFacts, RobotFacts
from rce_fleet.tasks.records import PlannerRun, Zone
from rce_fleet.tasks.zone_costs import OwnCosts

RUN = PlannerRun("1.0", "8 x 8")
SPILL = Zone("spill", "blocked", (5, 6), reason="oil", user="anna")


class Both:
    """A book, a planner that does what it is told, and a clock."""

    def __init__(self, book: TaskBook | None = None, run: PlannerRun = RUN) -> None:
        self.book = book or TaskBook()
        self.facts = FleetFacts(is_live=True, is_current=True, requested=frozenset())
        self.facts.robots["Robot1"] = RobotFacts("Robot1", "idle", cell=0)
        self.costs: OwnCosts = {}
        self.sync = PlannerSync(self.book, self.facts)
        self.now = 1000.0
        self.sync.begin(run, self.now)
        self.facts.requested = frozenset()

    def step(self, seconds: float = 3.0, *, refused: bool = False) -> list[PlannerCall]:
        """Let time pass; the planner carries out what it is told, unless it refuses."""
        self.now += seconds
        self.sync.adopt(self.now)
        calls = self.sync.calls(self.now)
        for call in calls:
            self.sync.took(call, self.now, refused=refused)
            if not refused:
                self._carry_out(call)
        return calls

    def _carry_out(self, call: PlannerCall) -> None:
        facts = self.facts
        if isinstance(call, SetMode):
            if call.robot:
                facts.robots[call.robot].mode = call.mode
            else:
                facts.mode = call.mode
        elif isinstance(call, BlockCell):
            assert facts.requested is not None
            facts.requested = facts.requested | {call.cell} if call.blocked else facts.requested - {call.cell}
            facts.blocks.pop(call.cell, None)
            if call.blocked:
                facts.blocks[call.cell] = call.block
        elif isinstance(call, SetCosts):
            self.costs = call.costs
        elif call.zone is None:
            del facts.zones[call.id]
        else:
            facts.zones[call.id] = read_zone(zone_fields(call.zone, self.now), self.now)

    def confirm(self) -> int:
        """Keep what the planner confirmed; return the number of records."""
        confirmed = self.sync.confirmed()
        for record in confirmed:
            self.book.put_record(record)
        return len(confirmed)

    def mode(self, name: str = "Robot1") -> str:
        return self.book.entry(name).mode
