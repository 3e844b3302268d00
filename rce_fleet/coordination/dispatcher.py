"""Carries out what the fleet's state requires: stops and places robots, grants cells, requests plans.

The planner handles events and records their changes; :meth:`Dispatcher.advance` then does everything that has
become possible. It finds that by the indexes of the state and of the ledger, so the cost of an event does not
depend on the number of robots.
"""

from __future__ import annotations

from itertools import islice
from math import isnan
from typing import TYPE_CHECKING

from rce_fleet.coordination.events import BlockedChanged, Instruction, SendCancel, SendCells
from rce_fleet.coordination.modes import RobotMode
from rce_fleet.coordination.move_client import ClientState
from rce_fleet.coordination.path_supply import PathSupply
from rce_fleet.coordination.placement import Placement
from rce_fleet.coordination.progress import arrived_index
from rce_fleet.coordination.robot import Cause, Phase, RobotRecord
from rce_fleet.exceptions import InvariantError

if TYPE_CHECKING:
    from collections.abc import Iterable

    from rce_fleet.coordination.fleet_state import FleetState
    from rce_fleet.coordination.replanning import PlanResult
    from rce_fleet.coordination.settings import FleetSettings


class Dispatcher:
    """Moves the robots of a fleet on.

    Attributes:
        now: Time of the current event, seconds.
        out: Its instructions so far.
        is_tick: Whether the current event is a tick.
        at_once: Whether robots that it concerns get new paths before the next tick.
        left: Pending cells that may be free of robots now.
        expected: Robots that no cells are granted before, until they have sent a pose, and until when.

    Args:
        state: The fleet.
        settings: Sizes and times.
    """

    def __init__(self, state: FleetState, settings: FleetSettings) -> None:
        self.state = state
        self.settings = settings
        self.now = 0.0
        self.out: list[Instruction] = []
        self.is_tick = False
        self.at_once = False
        self.left: set[int] = set()
        self.expected: dict[str, float] = {}
        self._placement = Placement(state, settings, self)
        self._paths = PathSupply(state, settings)
        self._ripe: dict[str, None] = {}
        """Robots that may be granted further cells, and had no turn yet, in the order of their turns."""

    @property
    def to_settle(self) -> set[str]:
        """Robots that may stand still now; to be added to."""
        return self._placement.to_settle

    def advance(self) -> None:
        """Do everything that has become possible."""
        for freed in self._placement.settle_standing():
            self.left |= freed
        self._block_left_cells()
        if self._paths.continue_plan(self.now):
            self._grant()
        self.state.refresh()
        if self._expects():
            return
        request = self._paths.supply(self.now, is_tick=self.is_tick, at_once=self.at_once)
        if request is not None:
            self.out.append(request)
        elif self._paths.is_quiet:
            self._grant()
            self.state.refresh()

    def _expects(self) -> bool:
        """Return whether robots exist whose places are not known yet."""
        if not self.expected:
            return False
        robots = self.state.robots
        self.expected = {
            robot: until
            for robot, until in self.expected.items()
            if until > self.now and (robot not in robots or isnan(robots[robot].x))
        }
        return bool(self.expected)

    def is_taking_over(self) -> bool:
        """Return whether the rest of a plan, or of its first grants, follows with the next events."""
        return self._paths.is_taking_over or bool(self._ripe)

    def take_plan(self, result: PlanResult) -> None:
        """Begin to take over the requested plan; ignore any other."""
        self._paths.take_plan(result, self.now)

    def require(self, robots: Iterable[str]) -> None:
        """Note that robots need new paths, and that the state changed since the newest plan request."""
        self._paths.require(robots)

    def hold(self, record: RobotRecord, reason: str) -> None:
        """Stop a robot, to take its cells back once it stands still."""
        if record.phase is Phase.SILENT:
            return
        record.held_at = self.now
        self.state.change(record, Cause.HELD, reason)
        if self.state.ledger.length(record.id):
            self.state.ledger.truncate(record.id)
        self.require([record.id])
        self.send(record, ())

    def avoid(self, record: RobotRecord) -> None:
        """Have all others plan around the cells that a robot claims."""
        cells = self.state.ledger.claims(record.id)
        self.require({robot for cell in cells for robot in self.state.ledger.visitors(cell)} - {record.id})

    def watch(self, record: RobotRecord) -> None:
        """Claim the free cells that a robot overlaps, and stop robots that would drive there.

        It keeps its granted cells: it may still drive there, or be there, if the pose is wrong. Poses of a
        lost robot that has a cell do not count.
        """
        ledger, has_cell = self.state.ledger, self.state.ledger.length(record.id) > 0
        if record.lost and has_cell:
            return
        before = ledger.claims(record.id)
        hull = set() if isnan(record.x) else self._placement.hull(record)
        ledger.overlap(record.id, self._beside(record, hull) if has_cell else self._around(record))
        claims = ledger.claims(record.id)
        wanted = hull | record.earlier | record.doubted
        self._retry_beside(record.id)
        self.state.index.displaced.put(record.id, () if wanted <= claims else wanted)
        if claims != before:
            self.avoid(record)
            self.require(other.id for other in self.state.robots.values() if other.unreachable)
            if record.phase is Phase.SILENT and not hull <= before:
                self._stop_silent(record)  # It would be driven back to its cells, through those of others.
        if not has_cell or not hull <= before:
            self.make_room(record)

    def _retry_beside(self, robot: str) -> None:
        """Look again at robots that wait for a place beside one that overlaps their cells, which may move."""
        index = self.state.index
        if robot in index.displaced.cells:
            self.to_settle.update(index.hindered.at(index.displaced.cells[robot]))

    def forget(self, robot: str) -> None:
        """Note that a robot is being removed."""
        self.expected.pop(robot, None)
        self._retry_beside(robot)

    def _beside(self, record: RobotRecord, hull: set[int]) -> set[int]:
        """Return the cells that a robot with a cell overlaps, if its hull is not within its cells."""
        ledger, touched = self.state.ledger, self._placement.touched(record)
        if hull <= ledger.claims(record.id):
            touched &= ledger.overlapped(record.id)
        return {cell for cell in touched | record.doubted if not self.state.is_blocked(cell)}

    def _around(self, record: RobotRecord) -> set[int]:
        """Return the cells that a robot without a cell overlaps or may drive to.

        A robot that drives was granted cells by an earlier planner: they are claimed until it stands. A robot
        that lies dead on the floor does not reach them.
        """
        if isnan(record.x):
            return {*self.state.ledger.claims(record.id), *self._may_reach(record)}
        touched = self._placement.touched(record)
        is_dead = self.state.mode_of(record) is RobotMode.DEAD
        return touched if is_dead else touched | record.doubted | self._may_reach(record)

    def _stop_silent(self, record: RobotRecord) -> None:
        """Stop a silent robot as well as possible: its move client may hear. It keeps its cells."""
        self.out.append(SendCancel(record.id))
        self.send(record, ())

    def _may_reach(self, record: RobotRecord) -> frozenset[int]:
        """Return the cells that an earlier planner granted a robot, and that it may still drive to."""
        report = record.report
        if report is None:
            return record.earlier
        if isnan(record.x) or report.state is ClientState.DRIVING:
            return frozenset(cell for cell in report.cells if cell in self.state.grid)
        # While it brakes it keeps what it has.
        is_braking = report.state is ClientState.CANCELLING
        return self.state.ledger.claims(record.id) if is_braking else frozenset()

    def make_room(self, record: RobotRecord) -> None:
        """Stop robots that were granted cells which another robot overlaps; silent ones may hear it."""
        for cell in () if isnan(record.x) else sorted(self._placement.touched(record)):
            owner = self.state.ledger.owner(cell)
            other = self.state.robots.get(owner) if owner is not None else None
            if other is None or other is record or not self._meets(other, cell, record):
                continue
            if other.phase is Phase.ACTIVE:
                self.hold(other, f"{record.id} is in its way")
            elif other.phase is Phase.SILENT and self.now - other.sent_at >= self.settings.repeat_after:
                self._stop_silent(other)

    def _meets(self, record: RobotRecord, cell: int, other: RobotRecord) -> bool:
        """Return whether a robot may drive towards another one that overlaps a cell of it."""
        granted = self.state.ledger.granted(record.id)
        if cell in granted[1:]:
            return True
        if record.phase is not Phase.ACTIVE or (record.centred and len(granted) == 1):
            return False
        return not self._placement.keeps_off([(record.x, record.y), *self._centres(granted)], other)

    def has_room(self, record: RobotRecord) -> bool:
        """Return whether a robot's way along its granted cells keeps off robots in cells of others."""
        claims, granted = self.state.ledger.claims(record.id), self.state.ledger.granted(record.id)
        places = [(record.x, record.y), *self._centres(granted)]
        others = self._placement.beside(record.id, claims)
        return all(self._placement.keeps_off(places, other) for other in others)

    def _centres(self, cells: Iterable[int]) -> list[tuple[float, float]]:
        return [self.state.grid.centre(cell) for cell in cells]

    def _way_is_clear(self, record: RobotRecord) -> bool:
        """Return whether a robot's way to the next cell of its path keeps off robots in cells of others."""
        if not self.state.index.displaced.cells:
            return True
        route, granted = self.state.ledger.route(record.id), len(self.state.ledger.granted(record.id))
        cells = route[granted - 1 : granted + 1]
        others = self._placement.beside(record.id, cells)
        return all(self._placement.keeps_off(self._centres(cells), other) for other in others)

    def _block_left_cells(self) -> None:
        if not self.left:
            return
        left, self.left = self.left & self.state.pending, set()
        free = [cell for cell in left if self.state.ledger.owner(cell) is None]
        for cell in free:
            self.state.block(cell)
        if free:
            self.out.append(BlockedChanged(tuple(sorted(self.state.blocked))))

    def _grant(self) -> None:
        """Grant cells to robots whose turn it may be; to some of them, if there are many."""
        left = self.settings.robots_per_step
        self._take_ripe()
        while left and self._ripe:
            robots = list(islice(self._ripe, left))
            left -= len(robots)
            for robot in robots:
                del self._ripe[robot]
                self._grant_one(robot)
            self._take_ripe()  # A robot that was held gave cells back.

    def _take_ripe(self) -> None:
        self._ripe |= dict.fromkeys(sorted(self.state.ledger.take_ripe()))

    def _grant_one(self, robot: str) -> None:
        ledger, record = self.state.ledger, self.state.robots.get(robot)
        if record is None or record.phase is not Phase.ACTIVE or record.leaving:
            return
        if not self._way_is_clear(record) and ledger.may_grant(robot, self.settings.ahead):
            self.hold(record, "another robot is in its way")
        elif ledger.grant(robot, self.settings.ahead):
            self.send(record, tuple(ledger.granted(robot)))

    # One robot

    def arrive(self, record: RobotRecord, *, is_standing: bool = False) -> bool:
        """Release the cells that a robot has left; return whether it is on its path.

        A robot that is judged by its poses alone keeps one cell more behind it, unless it ``is_standing``.
        """
        granted = self.state.ledger.granted(record.id)
        index = arrived_index(self.state.grid, granted, record.x, record.y, self.settings)
        if index is None:
            return False
        if record.pose_only and not is_standing:
            index = max(index - 1, 0)
        index = min(index, self._target_index(record, granted))
        hull = self._placement.hull(record) if index else set()
        while index and granted[index - 1] in hull:
            index -= 1  # It cuts a corner, and is still partly in the cell before.
        extra = self.state.ledger.overlapped(record.id)
        if index > 0 or extra or not record.centred:
            if record.leaving:
                self._ripe[record.id] = None
            record.centred, record.leaving = True, False
            self.state.touch(record)
            still = extra and extra & self._placement.hull(record)
            self.state.ledger.arrive(record.id, index, still)
        return True

    def _target_index(self, record: RobotRecord, granted: list[int]) -> int:
        """Return the index of the cell that a robot's move client drives it to; the last if it says none.

        A robot that was pushed along its path drives back to that cell, or to the first one of its list if it
        was pushed before its move client drove by that list.
        """
        report, last = record.report, len(granted) - 1
        if report is None or record.pose_only:
            return last
        if report.state is ClientState.DRIVING:
            return granted.index(report.target) if report.target in granted else last
        if report.state is not ClientState.CANCELLING and report.revision == record.revision:
            return last
        return min(granted.index(report.reached) + 1, last) if report.reached in granted else 0

    def is_pushed(self, record: RobotRecord) -> bool:
        """Return whether a robot was pushed along its path, and cannot drive back within its cells.

        One cell past its target it may be by itself: the report of its next target is on its way.
        """
        granted = self.state.ledger.granted(record.id)
        target = self._target_index(record, granted)
        if target + 2 >= len(granted):
            return False
        index = arrived_index(self.state.grid, granted, record.x, record.y, self.settings)
        if index is None or index <= target + 1:
            return False
        return not self._placement.swept(record, granted[target]) <= self.state.ledger.claims(record.id)

    def has_left(self, record: RobotRecord) -> bool:
        """Return whether a robot that is not on its path was carried out of its granted cells."""
        here = self.state.grid.cell_at(record.x, record.y)
        granted = self.state.ledger.granted(record.id)
        if here in granted or (record.leaving and here in self.state.ledger.overlapped(record.id)):
            return False
        # It may begin in a cell that is shut, and that it only overlaps.
        in_others = here not in self.state.ledger.claims(record.id)
        return in_others or self._placement.nearest(record) not in granted

    def is_in_last_cell(self, record: RobotRecord) -> bool:
        """Return whether a robot's pose is in the last cell that it was granted."""
        return self._placement.nearest(record) == self.state.ledger.end_of_grant(record.id)

    def arrive_by_pose(self, record: RobotRecord, now: float) -> None:
        """Release the last cell behind a robot that is judged by its poses, once it has stood for a while."""
        if now - record.still_since() >= self.settings.pose_only_settle:
            self.arrive(record, is_standing=True)

    def send(self, record: RobotRecord, cells: tuple[int, ...]) -> None:
        """Send a robot its cells; stop it first if it must stand still."""
        record.sent_at = self.now
        if record.phase is Phase.HOLDING:
            self.out.append(SendCancel(record.id))
        speed = self.state.zones.speed_limit(record.id, cells)
        self.out.append(SendCells(record.id, record.next_revision(), cells, speed))

    def send_again(self, robots: Iterable[str]) -> None:
        """Send active robots their granted cells again, because a limit of their speed changed."""
        for robot in sorted(robots):
            record = self.state.robots[robot]
            if record.phase is Phase.ACTIVE:
                self.send(record, tuple(self.state.ledger.granted(robot)))

    def _is_granting(self) -> bool:
        """Return whether everything that can be granted was granted with the last event."""
        return self._paths.is_quiet and not self._ripe and not self.expected

    def validate(self) -> None:
        """Check that everything that is possible was done.

        Raises:
            InvariantError: Something was not done.
        """
        state = self.state
        self._placement.validate()
        for record in state.robots.values() if self._is_granting() else ():
            may_drive = record.phase is Phase.ACTIVE and not record.leaving
            if may_drive and state.ledger.may_grant(record.id, self.settings.ahead):
                raise InvariantError(f"{record.id} was not granted a cell that is free for it")
        undone = [cell for cell in state.pending if state.ledger.owner(cell) is None]
        if undone:
            raise InvariantError(f"cells {undone} are free and were not blocked")
