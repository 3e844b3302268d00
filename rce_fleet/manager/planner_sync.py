"""Brings modes, zones and blocked cells of journal and planner together. Pure.

People change them on both sides: by requests of the API, which the journal has first, and by the planner's
services, which the operator's page and other programs call without the manager. After a restart the planner
knows none of them, and gets the journal's.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from math import inf
from typing import TYPE_CHECKING, TypeAlias

from rce_fleet.limits import MOST_LIFETIME
from rce_fleet.manager.cell_blocks import describe_block
from rce_fleet.manager.mirror import REFUSED_S, SETTLE_S, Mirror
from rce_fleet.manager.zones import rule
from rce_fleet.tasks.other_floor import leave_floor
from rce_fleet.tasks.records import (
    AUTOMATIC,
    NOT_KNOWN,
    BlockedCells,
    CellBlock,
    FleetEntry,
    PlannerRun,
    RobotEntry,
    Zone,
)
from rce_fleet.tasks.zone_costs import own_costs

if TYPE_CHECKING:
    from rce_fleet.tasks.book import TaskBook
    from rce_fleet.tasks.facts import FleetFacts
    from rce_fleet.tasks.zone_costs import OwnCosts

CELLS_DELAY_S = 6.0
"""Longest time after which the planner's list of blocked cells has an accepted one: a list counts only when
the planner was heard again after it."""
ENDS_NEAR_S = 10.0
"""Ends of a zone in journal and planner differ by so much at most: by how long messages take, and because a
program that prolongs its zone often shall not fill the journal."""
FLEET = ""
"""Stands for the whole fleet where modes are by robot."""
_LATE_S = 1.0
"""So much later than in the journal a zone may end at the planner because it was told later."""
_NOT_TOLD = 0, -inf
_NEVER_TOLD = NOT_KNOWN, -inf
_MOST_NAMED = 10
"""So many cells are named in the text of one event."""


@dataclass(frozen=True, slots=True)
class SetMode:
    """Set who drives a robot, or the fleet's mode (robot empty)."""

    robot: str
    mode: str
    reason: str
    user: str


@dataclass(frozen=True, slots=True)
class SetZone:
    """Make or replace a zone, or remove it (zone None)."""

    id: str
    zone: Zone | None


@dataclass(frozen=True, slots=True)
class BlockCell:
    """Block or free a cell; who blocks it, and why, is told with it."""

    cell: int
    blocked: bool
    block: CellBlock = NOT_KNOWN


@dataclass(frozen=True, slots=True)
class SetCosts:
    """Set what metres in zones count for single robots, for all robots at once."""

    costs: OwnCosts = field(repr=False)


PlannerCall: TypeAlias = SetMode | SetZone | SetCosts | BlockCell


class PlannerSync:
    """Compares the book with the planner's state.

    Args:
        book: What people decided.
        facts: What the planner says.
    """

    def __init__(self, book: TaskBook, facts: FleetFacts) -> None:
        self._book = book
        self._facts = facts
        self._modes: Mirror[str, str] = Mirror()
        self._zones: Mirror[str, Zone] = Mirror()
        self._cells: Mirror[int, bool] = Mirror(CELLS_DELAY_S)
        self._told: dict[str, tuple[int, float]] = {}
        """Which revision of a zone the planner accepted last, and when."""
        self._told_blocks: dict[int, tuple[CellBlock, float]] = {}
        """Who blocked a cell, and why, as the planner accepted it last, and when."""
        self._costs: OwnCosts | None = None
        """The own costs of robots that the planner has; None: not known."""
        self._costs_from = -inf
        """When they may be sent again."""
        self._run = PlannerRun()
        self._unlisted: dict[int, float] = {}
        """Until when the planner's list need not have cells that are blocked since a robot has left them."""

    def take_book(self, book: TaskBook) -> None:
        """Continue with another book, made from the journal again."""
        self._book = book

    def begin(self, run: PlannerRun, now: float) -> str:
        """Begin with a planner that was started, or is heard for the first time.

        Args:
            run: The planner.
            now: Seconds since 1970.

        Returns:
            What people should know; empty: nothing.
        """
        book, known = self._book, self._book.planner
        is_same = run.started == known.started
        is_other_floor = run.has_other_floor(known)
        self._modes.restart({**self._modes_kept(), **self._unsent_modes()} if is_same else {})
        keeps = is_same or is_other_floor
        unsent = self._unsent_removals() if not is_other_floor else {}
        self._zones.restart({**self._zones_kept(), **unsent} if keeps else {})
        # Another grid has none of the zones: what was not sent is not wanted there.
        self._told = {zone.id: (zone.revision, now) for zone in book.zones.values()} if is_other_floor else {}
        told = dict.fromkeys(book.blocked.cells, True)
        # False: a stand-in that no cell equals, for those that the planner may not have, or still has.
        waiting = dict.fromkeys(() if is_other_floor else book.blocked.unsent, False)
        self._cells.restart({**told, **waiting} if keeps else {})
        kept = book.blocked.cells if is_other_floor else ()
        self._told_blocks = {cell: (book.blocked.block(cell), now) for cell in kept}
        self._facts.requested = None if keeps else frozenset()  # a planner that begins has no requests
        has_profiles = any(entry.profile is not None for entry in book.robots.values())
        self._costs, self._costs_from = None if is_same and has_profiles else {}, -inf
        self._run = run
        self._unlisted.clear()
        self._note_run(now)
        if not is_other_floor:
            return ""
        lost = len(book.zones) + len(book.blocked.cells)
        return (
            f"the planner has another grid: its zones and blocked cells replace the {lost} known ones, open"
            " tasks are held, and chargers, parking places and return cells are removed"
        )

    def adopt(self, now: float) -> None:
        """Take over into the book what was changed at the planner, and end zones whose time has come.

        Args:
            now: Seconds since 1970.
        """
        book, facts = self._book, self._facts
        is_comparable = self._is_comparable()
        if is_comparable:
            self._adopt_ends(now)
        for zone in list(book.zones.values()):
            if zone.until is not None and zone.until <= now:
                is_sent = is_comparable or zone.unsent
                gone = replace(zone, is_removed=True, revision=zone.revision + 1, unsent=is_sent)
                book.emit(gone, "zone ended", now, text=f"zone {zone.id} has ended")
                if not is_sent:
                    self._zones.forget(zone.id)  # it may have been prolonged at a planner that is silent now
        if not is_comparable:
            self._end_cells(now)
            return
        self._note_run(now)  # again, if the journal could not be written
        self._note_pending(now)
        for name, mode in self._modes.compare(*self._modes_of_both(), now).to_adopt.items():
            self._adopt_mode(name, mode or AUTOMATIC, now)
        zones = self._zones.compare(*self._zones_of_both(), now, self._untold())
        for key, zone_seen in zones.to_adopt.items():
            if zone_seen is None or key in book.zones or _end(facts.zones[key], now) > now + _LATE_S:
                self._adopt_zone(key, zone_seen, now)
        if facts.requested is not None:
            changes = self._cells.compare(*self._cells_of_both(), now, self._untold_cells()).to_adopt
            self._adopt_cells(changes, now)
            self._adopt_blocks(now)

    def calls(self, now: float) -> list[PlannerCall]:
        """Return what the planner has to be told now; modes first.

        Args:
            now: Seconds since 1970.
        """
        if not self._is_comparable():
            return []
        book, out = self._book, list[PlannerCall]()
        for name, mode in self._modes.compare(*self._modes_of_both(), now).to_send.items():
            entry = book.fleet if name == FLEET else book.entry(name)
            out.append(SetMode(name, mode or AUTOMATIC, entry.reason, entry.user))
        for key in self._zones.compare(*self._zones_of_both(), now, self._untold()).to_send:
            out.append(SetZone(key, book.zones.get(key)))
        costs = own_costs(book)
        if costs != self._costs and now >= self._costs_from:
            out.append(SetCosts(costs))
        if self._facts.requested is not None:
            cells = self._cells.compare(*self._cells_of_both(), now, self._untold_cells()).to_send
            out += [BlockCell(cell, bool(one), book.blocked.block(cell)) for cell, one in cells.items()]
        return out

    def took(self, call: PlannerCall, now: float, *, refused: bool) -> None:
        """Note that the planner carried out or refused a call.

        Args:
            call: The call.
            now: Seconds since 1970.
            refused: Whether it refused.
        """
        if isinstance(call, SetMode):
            self._modes.sent(call.robot, None if call.mode == AUTOMATIC else call.mode, now, refused=refused)
        elif isinstance(call, SetZone):
            self._zones.sent(call.id, None if call.zone is None else rule(call.zone), now, refused=refused)
            if call.zone is not None and not refused:
                self._told[call.id] = call.zone.revision, now
        elif isinstance(call, SetCosts):
            self._costs_from = now + REFUSED_S if refused else -inf
            self._costs = self._costs if refused else call.costs
        else:
            self._cells.sent(call.cell, True if call.blocked else None, now, refused=refused)
            if not refused:
                self._told_blocks.pop(call.cell, None)
            if call.blocked and not refused:
                self._told_blocks[call.cell] = call.block, now

    def undo_zone(self, zone: Zone, before: Zone | None, now: float, refusal: str) -> bool:
        """Take back a zone that a request made, and that the planner refused; return whether it was there.

        Args:
            zone: The zone.
            before: What it replaced; None: nothing.
            now: Seconds since 1970.
            refusal: Why the planner refused it.
        """
        known = self._book.zones.get(zone.id)
        if known is None or not known.unsent or known.revision != zone.revision:
            return False
        back = replace(known, is_removed=True, unsent=False) if before is None else before
        revision, told_at = self._told.get(zone.id, _NOT_TOLD)
        if revision == back.revision:
            self._told[zone.id] = known.revision + 1, told_at
        text = f"zone {zone.id} is as it was before: {refusal}"
        self._book.emit(replace(back, revision=known.revision + 1), "refused", now, text=text)
        return True

    def confirmed(self) -> list[RobotEntry | FleetEntry | Zone | BlockedCells]:
        """Return records whose change by a request the planner has now, marked so."""
        if not self._is_comparable():
            return []
        book, modes, zones = self._book, self._modes_kept(), self._zones_kept()
        entries = [entry for entry in book.robots.values() if entry.unsent]
        untold, candidates = self._untold(), (*book.zones.values(), *book.removed_zones.values())
        changed = [zone for zone in candidates if zone.unsent and zone.id not in untold]
        fleet = [book.fleet] if book.fleet.unsent and self._modes.is_known(FLEET, modes.get(FLEET)) else []
        return [
            *self._confirmed_cells(),
            *(replace(each, unsent=False) for each in fleet),
            *(
                replace(each, unsent=False)
                for each in entries
                if self._modes.is_known(each.id, modes.get(each.id))
            ),
            *(
                replace(each, unsent=False)
                for each in changed
                if self._zones.is_known(each.id, zones.get(each.id))
            ),
        ]

    def _confirmed_cells(self) -> list[BlockedCells]:
        blocked = self._book.blocked
        kept = dict.fromkeys(blocked.cells, True)
        untold = self._untold_cells()
        waiting = tuple(
            cell
            for cell in blocked.unsent
            if cell in untold or not self._cells.is_known(cell, kept.get(cell))
        )
        return [] if waiting == blocked.unsent else [replace(blocked, unsent=waiting)]

    # What both have

    def _is_comparable(self) -> bool:
        return self._facts.is_live and self._facts.is_current and bool(self._run.started)

    def _note_run(self, now: float) -> None:
        known = self._book.planner
        if self._run != known:
            is_other_floor = self._run.has_other_floor(known)
            if is_other_floor:
                leave_floor(self._book, now)
            text = "the planner has another grid" if is_other_floor else "the planner began"
            self._book.emit(self._run, "planner", now, text=text)

    def _note_pending(self, now: float) -> None:
        """Note which cells the planner's list of blocked cells has later than its state."""
        facts = self._facts
        left = {
            cell: min(until, now + CELLS_DELAY_S)
            for cell, until in self._unlisted.items()
            if until > now and cell in facts.shut
        }
        self._unlisted = {**left, **dict.fromkeys(facts.pending, inf)}

    def _modes_kept(self) -> dict[str, str]:
        entries = {name: entry.mode for name, entry in self._book.robots.items()}
        entries[FLEET] = self._book.fleet.mode
        return {name: mode for name, mode in entries.items() if mode != AUTOMATIC}

    def _modes_of_both(self) -> tuple[dict[str, str], dict[str, str]]:
        """Return the modes of robots that the planner knows, and of the fleet."""
        facts = self._facts
        kept, seen = self._modes_kept(), {FLEET: facts.mode}
        for name in self._book.robots:
            if name not in facts.robots or not facts.robots[name].is_known:
                kept.pop(name, None)
                self._modes.forget(name)
        for name, robot in facts.robots.items():
            if not robot.is_known:
                continue
            wanted = kept.get(name)
            is_covered = facts.mode != AUTOMATIC and robot.mode == facts.mode
            # The fleet's mode hides the robot's own one.
            hidden = is_covered and self._modes.is_known(name, wanted)
            seen[name] = (wanted or AUTOMATIC) if hidden else robot.mode
        return kept, {name: mode for name, mode in seen.items() if mode != AUTOMATIC}

    def _unsent_modes(self) -> dict[str, str]:
        """Return stand-ins that no mode equals, for robots or a fleet whose mode the planner may not have."""
        book = self._book
        robots = {name: "" for name, entry in book.robots.items() if entry.unsent}
        return {**robots, FLEET: ""} if book.fleet.unsent else robots

    def _unsent_removals(self) -> dict[str, Zone]:
        """Return stand-ins that no zone equals, for removed zones that the planner may still have."""
        return {name: Zone(name, "", ()) for name in self._book.removed_zones}

    def _untold(self) -> set[str]:
        """Return zones that the planner was not told since a request changed them, maybe only their end."""
        told = self._told
        unsent = (zone for zone in self._book.zones.values() if zone.unsent)
        return {zone.id for zone in unsent if told.get(zone.id, _NOT_TOLD)[0] != zone.revision}

    def _untold_cells(self) -> set[int]:
        """Return blocked cells of which the planner was not told what a request changed, maybe only why."""
        blocked, told = self._book.blocked, self._told_blocks
        return {
            cell
            for cell in {*blocked.unsent} & {*blocked.cells}
            if cell not in told or told[cell][0] != blocked.block(cell)
        }

    def _zones_kept(self) -> dict[str, Zone]:
        return {zone.id: rule(zone) for zone in self._book.zones.values()}

    def _zones_of_both(self) -> tuple[dict[str, Zone], dict[str, Zone]]:
        return self._zones_kept(), {zone.id: rule(zone) for zone in self._facts.zones.values()}

    def _cells_of_both(self) -> tuple[dict[int, bool], dict[int, bool]]:
        kept = dict.fromkeys(self._book.blocked.cells, True)
        seen = dict.fromkeys(self._facts.requested or (), True)
        unlisted = self._facts.pending.union(self._facts.shut.intersection(self._unlisted))
        waiting = {cell: True for cell in kept if cell in unlisted}
        return kept, {**seen, **waiting}

    # What the book takes over

    def _adopt_mode(self, name: str, mode: str, now: float) -> None:
        book = self._book
        if name == FLEET:
            fleet = FleetEntry(mode, revision=book.fleet.revision + 1)
            book.emit(fleet, mode, now, text=f"the fleet is {_words(mode)}")
            return
        entry, reason = book.entry(name), "" if mode == AUTOMATIC else self._facts.robots[name].mode_reason
        changed = replace(entry, mode=mode, reason=reason, user="", revision=entry.revision + 1, unsent=False)
        book.emit(changed, mode, now, text=f"{name} is {_words(mode)}" + (f": {reason}" if reason else ""))

    def _adopt_zone(self, key: str, seen: Zone | None, now: float) -> None:
        book, known = self._book, self._book.zones.get(key)
        if seen is None:
            if known is not None:
                gone = replace(known, is_removed=True, revision=known.revision + 1, unsent=False)
                book.emit(gone, "zone removed", now, text=f"zone {key} is gone")
            return
        made = replace(self._facts.zones[key], revision=book.next_revision(known))
        book.emit(made, "zone", now, user=made.user, text=f"zone {key}: {made.kind}")

    def _adopt_ends(self, now: float) -> None:
        """Take over ends of zones that were changed at the planner, where they are still to come."""
        for key, seen in self._facts.zones.items():
            known, (_, told_at) = self._book.zones.get(key), self._told.get(key, _NOT_TOLD)
            if known is None or known.unsent or now < told_at + SETTLE_S:
                continue
            here, there = _end(known, now), _end(seen, now)
            is_other = here != there and (here <= now or abs(there - here) > ENDS_NEAR_S)
            if is_other and there > now + _LATE_S and rule(known) == rule(seen):
                self._adopt_zone(key, seen, now)

    def _adopt_cells(self, changes: dict[int, bool | None], now: float) -> None:
        if not changes:
            return
        before = self._book.blocked
        gone = [cell for cell, blocked in changes.items() if not blocked]
        ended = [cell for cell in gone if before.block(cell).has_ended(now + _LATE_S)]
        made = before.changed(
            {cell: bool(one) for cell, one in changes.items()}, unsent=False, blocks=self._blocks_seen()
        )
        what, text = "blocked", f"{len(made.cells)} cells are blocked"
        if len(ended) == len(changes):
            what, text = "freed", _words_of_ended(ended)
        users = {made.block(cell).user for cell in changes}
        self._book.emit(made, what, now, user=users.pop() if len(users) == 1 else "", text=text)

    def _blocks_seen(self) -> dict[int, CellBlock]:
        """Return who blocked cells at the planner, without those that only sensors found blocked."""
        return {cell: block for cell, block in self._facts.blocks.items() if not block.robot}

    def _adopt_blocks(self, now: float) -> None:
        """Take over who blocked cells, why and until when, where that was changed at the planner."""
        blocked = self._book.blocked
        found: dict[int, CellBlock] = {}
        for cell in {*blocked.cells}.difference(blocked.unsent):
            seen, (_, told_at) = self._facts.blocks.get(cell), self._told_blocks.get(cell, _NEVER_TOLD)
            if seen is None or seen.robot or not self._cells.is_known(cell, value=True):
                continue
            known = blocked.block(cell)
            is_other = (known.user, known.reason) != (seen.user, seen.reason)
            is_other |= abs(_end(known, now) - _end(seen, now)) > ENDS_NEAR_S
            if is_other and now >= told_at + SETTLE_S:
                found[cell] = seen
        if found:
            made = blocked.changed(dict.fromkeys(found, True), unsent=False, blocks=found)
            text = ", ".join(describe_block(cell, found[cell]) for cell in sorted(found)[:_MOST_NAMED])
            self._book.emit(made, "blocked", now, text=text)

    def _end_cells(self, now: float) -> None:
        """End blocks whose time has come while the planner is silent; one that is heard frees them itself."""
        blocked = self._book.blocked
        ended = [cell for cell in blocked.cells if blocked.block(cell).has_ended(now - CELLS_DELAY_S)]
        if ended:
            made = blocked.changed(dict.fromkeys(ended, False), unsent=False)
            self._book.emit(made, "freed", now, text=_words_of_ended(ended))
            for cell in ended:
                self._cells.forget(cell)  # it may have been blocked again at a planner that is silent now


def _words_of_ended(cells: list[int]) -> str:
    named = ", ".join(map(str, cells[:_MOST_NAMED]))
    return f"the time of blocked cells has ended: {named}" + (" ..." if len(cells) > _MOST_NAMED else "")


def _end(zone: Zone | CellBlock, now: float) -> float:
    """Return when a zone or block ends; infinity also if it is too late to tell the planner the time."""
    until = inf if zone.until is None else zone.until
    return until if until < now + MOST_LIFETIME / 2 else inf


def _words(mode: str) -> str:
    return mode.replace("_", " ")
