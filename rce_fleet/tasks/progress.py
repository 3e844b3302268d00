"""Carries tasks out: robots go from stop to stop, act there, and lose or end their tasks by rule."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import TYPE_CHECKING

from rce_fleet.tasks.order import Action, Stop
from rce_fleet.tasks.task import RETURN, StopVisit, Task, TaskCause, TaskState

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

    from rce_fleet.tasks.book import TaskBook
    from rce_fleet.tasks.charging import ChargerUser
    from rce_fleet.tasks.facts import FleetFacts, RobotFacts


BATTERY_WAIT_S = 30.0
"""A robot whose battery is not heard for so long has none that could be charged. After a restart of the
manager, batteries are heard later than robots."""


@dataclass(frozen=True, slots=True)
class ProgressRules:
    """When a robot loses its task. Seconds.

    Attributes:
        lost_after: A robot that is silent this long gives its task up.
        stuck_after: So does one that has a goal and has not changed its cell for this long ...
        unreachable_after: ... or to whose goal no path has led for this long.
        load_lost_after: A task whose load is on a robot that cannot continue fails after this time.
        avoid_for: A robot that gave a task up does not get it again for this time.
    """

    lost_after: float = 15.0
    stuck_after: float = 120.0
    unreachable_after: float = 20.0
    load_lost_after: float = 3600.0
    avoid_for: float = 120.0


class TaskProgress:
    """Follows the robots that carry out tasks.

    Args:
        book: The tasks.
        rules: When a robot loses its task.
        charged: A stop that charges without a duration ends with this share of the full battery.

    Attributes:
        avoid: Until when a robot does not get a task again, by task's number and robot.
        standing: Cells of robots that stay where they are, and which robot is in each.
    """

    def __init__(self, book: TaskBook, rules: ProgressRules, charged: float = 0.95) -> None:
        self._book = book
        self._charged = charged
        self._rules = rules
        self.avoid: dict[tuple[int, str], float] = {}
        self.standing: dict[int, str] = {}
        self._taken: dict[int, str] = {}
        self._silent_until = 0.0
        """When the planner was silent last: until it is heard, what robots do is not known."""
        self._unknown_since: dict[str, float] = {}
        """Of robots with a task that the planner does not know."""
        self._retry_at: dict[int, float] = {}
        """When a robot tries again to bring a load for which it found no way, by task: until then its task is
        suspended, so that people can say where the load is."""
        self._tried_since: dict[int, float] = {}
        """Since when a task's robot has been sent to its stop, or has waited for the same reason; by task."""
        self._asked: dict[int, int] = {}
        """The stop before which people were asked for a load, by task."""
        self._warned: dict[int, int] = {}
        """The stop before which people were told of a low battery, by task."""

    def update(
        self,
        now: float,
        facts: FleetFacts,
        nearest: Callable[[RobotFacts, Iterable[int]], int | None],
        short_of_energy: Callable[[Task, RobotFacts], str] = lambda _task, _robot: "",
        charger_users: Mapping[int, ChargerUser] = MappingProxyType({}),
    ) -> None:
        """Take over what the robots did.

        Args:
            now: Seconds since 1970.
            facts: The robots.
            nearest: Returns which of some cells a robot reaches first; None: it reaches none of them.
            short_of_energy: Returns why a robot's battery is not enough for the rest of a task; empty: it is.
            charger_users: Idle robots that charge, by the charger's cell: a stop that charges leaves them
                there until their battery is sufficient.
        """
        self._nearest, self._short_of_energy = nearest, short_of_energy
        self._charger_users = charger_users
        self._elapsed = facts.elapsed
        self._silent_until = self._silent_until if facts.is_live else now
        self.avoid = {pair: until for pair, until in self.avoid.items() if until > now}
        self._taken = self.targets()
        self.standing = self._standing(facts)
        self._unknown_since = {
            name: since for name, since in self._unknown_since.items() if name not in facts.robots
        }
        self._retry_at = {number: at for number, at in self._retry_at.items() if at > now}
        self._asked, self._warned = (
            {number: stop for number, stop in told.items() if number in self._book.tasks}
            for told in (self._asked, self._warned)
        )
        self._tried_since = {
            number: since for number, since in self._tried_since.items() if number in self._book.tasks
        }
        for task in self._book.active_tasks():
            robot = facts.robots.get(task.robot)
            if task.state is TaskState.HELD:
                self._end_action(task, now, robot if robot is not None and robot.is_there else None)
            elif robot is None or not robot.is_there:
                self._miss(self._end_action(task, now), robot, now, facts)
            else:
                self._follow(task, robot, now, facts)

    def targets(self) -> dict[int, str]:
        """Return the cells that robots go to or act in for tasks, and for whom they are taken."""
        return {task.target: task.robot for task in self._book.active_tasks() if task.target is not None}

    def _standing(self, facts: FleetFacts) -> dict[int, str]:
        """Return the cells of robots that the planner does not drive, or that stand still with a load."""
        found = facts.standing()
        for task in self._book.active_tasks():
            robot = facts.robots.get(task.robot)
            if task.state in (TaskState.HELD, TaskState.SUSPENDED) and robot is not None:
                found.update({} if robot.cell is None or not robot.is_known else {robot.cell: robot.id})
        return found

    # Robots that are there

    def _follow(self, task: Task, robot: RobotFacts, now: float, facts: FleetFacts) -> None:
        entry = self._book.entry(robot.id)
        if entry.is_out:
            task = self._end_action(task, now, robot)
            self._give_up(task, now, f"{robot.id} was taken out of service", is_away=True)
            return
        if task.state is TaskState.SUSPENDED:
            if task.number in self._retry_at or not self._can_continue(task, robot):
                return
            task = self._book.advance(task, TaskCause.CONTINUE, now, f"{robot.id} can continue")
        if task.is_stranded:
            if task.number in self._retry_at or not self._can_continue(task, robot):
                if self._elapsed(task.changed_at, now) > self._rules.load_lost_after:
                    self._book.advance(task, TaskCause.FAIL, now, f"{task.reason}; it was not brought away")
                return
            task = replace(task, is_stranded=False, revision=task.revision + 1, reason="")
            self._book.emit(task, "continued", now, text=f"{robot.id} can continue")
        task = self._end_action(task, now, robot)
        while not task.has_ended and task.action is None:
            if not self._go(task, robot, now, facts):
                return
            task = self._end_action(self._book.tasks[task.number], now, robot)

    def _can_continue(self, task: Task, robot: RobotFacts) -> bool:
        """Return whether a path leads a robot with a load to its next stop; people are asked meanwhile."""
        stop, _ = self._stop_of(task, robot)
        if task.action is not None or not task.is_loaded or stop is None:
            return True
        return self._nearest(robot, self._cells_of(stop, robot)) is not None

    def _go(self, task: Task, robot: RobotFacts, now: float, facts: FleetFacts) -> bool:
        """Send the robot to the next stop; return whether it is there and its action began."""
        stop, number = self._stop_of(task, robot)
        if stop is None:
            self._finish(task, now)
            return False
        target = task.target
        is_between_stops = target is None and bool(task.visits) and task.state is TaskState.RUNNING
        if is_between_stops and (lack := self._short_of_energy(task, robot)):
            if not task.is_loaded:
                self._give_up(task, now, lack)
                return False
            self._warn_of_energy(task, lack, now)
        if target is None or (len(stop.cells) != 1 and self._is_closed(target, robot, facts)):
            task = self._choose(task, stop, robot, now)
            target = task.target
        if target is None:
            return False
        if not robot.is_at(target):
            if robot.is_driven:
                self._check_trouble(task, robot, now, facts)
            return False
        visits = (*task.visits, StopVisit(number, robot.id, target, now))
        begun = replace(task, visits=visits, revision=task.revision + 1, reason="", confirmed=False)
        what = "brings the load of the cancelled task" if number == RETURN else stop.action.value
        self._book.emit(begun, "arrived", now, text=f"{robot.id} is in cell {target}: {what}")
        return True

    def _is_closed(self, target: int, robot: RobotFacts, facts: FleetFacts) -> bool:
        """Return whether a robot cannot enter its target: another one of the stop's cells may be free."""
        return target in facts.shut or self.standing.get(target, robot.id) != robot.id

    def _warn_of_energy(self, task: Task, lack: str, now: float) -> None:
        """Tell people, once for each stop, that a robot with a load may not get to its end."""
        if self._warned.get(task.number) != task.position:
            self._warned[task.number] = task.position
            self._book.emit(
                replace(task, revision=task.revision + 1), "low battery", now, text=f"{task.robot}: {lack}"
            )

    def _stop_of(self, task: Task, robot: RobotFacts) -> tuple[Stop | None, int]:
        """Return the stop that comes next, and its number; a cancelled load goes where a path leads."""
        if task.state is not TaskState.CANCELLING:
            return task.next_stop, task.position
        if not task.is_loaded:
            return None, RETURN
        source = () if task.load_from is None else (task.load_from,)
        known = [cells for cells in (task.order.return_cells, self._book.places.returns, source) if cells]
        reached = (cells for cells in known if self._nearest(robot, cells) is not None)
        cells = next(reached, known[0] if known else ())
        duration = max((s.duration for s in task.order.stops if s.action is Action.DELIVER), default=0.0)
        return Stop(Action.DELIVER, cells, duration), RETURN

    def _choose(self, task: Task, stop: Stop, robot: RobotFacts, now: float) -> Task:
        """Choose the cell of a stop; without one that is free, the task says what it waits for."""
        cells = self._cells_of(stop, robot)
        users = self._charger_users if stop.action is Action.CHARGE else {}
        taken = {cell: user.robot for cell, user in users.items() if cell in cells and not user.can_leave}
        taken |= {cell: self._taken[cell] for cell in cells if self._taken.get(cell, robot.id) != robot.id}
        free = [cell for cell in cells if cell not in taken]
        clear = [cell for cell in free if self.standing.get(cell, robot.id) == robot.id and cell not in users]
        chosen = self._nearest(robot, clear)
        if chosen is None:  # a robot that stands there may drive on before this one arrives, or has to leave
            chosen = self._nearest(robot, free)
        if chosen is not None and chosen == task.target:
            return task
        if chosen is not None:
            self._taken[chosen] = robot.id
            if task.target is None:
                self._tried_since[task.number] = now
            sent = replace(task, target=chosen, revision=task.revision + 1, reason="")
            self._book.emit(sent, "sent", now, text=f"{robot.id} goes to cell {chosen}")
            return sent
        waits = [cell for cell in cells if cell in taken]
        if waits:
            reason = f"waits for cell {waits[0]}, which {taken[waits[0]]} uses"
        elif cells:
            reason = f"no path leads {robot.id} to cell {', '.join(map(str, cells[:5]))}"
        else:
            what = "return cells" if stop.action is Action.DELIVER else "chargers or parking places"
            reason = f"no cell is known for the stop {stop.action.value!r}: set {what}"
        if task.reason != reason:
            self._tried_since[task.number] = now
            task = replace(task, reason=reason, revision=task.revision + 1)
            self._book.emit(task, "waits", now, text=f"{task.id} {reason}")
        if not waits and self._waited(task, robot, now) > self._rules.unreachable_after:
            self._give_up(task, now, reason)
            return self._book.tasks[task.number]
        return task

    def _cells_of(self, stop: Stop, robot: RobotFacts) -> tuple[int, ...]:
        """Return the cells of which any one serves for a stop."""
        places = self._book.places
        if stop.action is Action.CHARGE:
            return stop.cells or places.chargers
        if stop.action is Action.PARK:
            return stop.cells or places.parking or ((robot.cell,) if robot.cell is not None else ())
        return stop.cells

    def _end_action(self, task: Task, now: float, robot: RobotFacts | None = None) -> Task:
        """End the action that is under way, if its time has come. An action is never begun twice."""
        visit = task.action
        if visit is None:
            return task
        stop = _stop_of_visit(task, visit)
        return self._acted(task, stop, visit, now) if self._is_over(task, stop, visit, now, robot) else task

    def _acted(self, task: Task, stop: Stop, visit: StopVisit, now: float, *, is_given: bool = True) -> Task:
        """Note that an action has ended; a load that was not given away is still on the robot."""
        loads = task.loads + (stop.action is Action.PICK)
        if is_given and stop.action is Action.DELIVER:
            loads = 0 if visit.stop == RETURN else loads - 1
        ended = replace(
            task,
            visits=(*task.visits[:-1], replace(visit, ended_at=now)),
            position=task.position + (visit.stop != RETURN),
            loads=max(0, loads),
            target=None,
            revision=task.revision + 1,
        )
        if self._taken.get(visit.cell) == visit.robot:
            del self._taken[visit.cell]
        self._book.emit(
            ended, "acted", now, text=f"{visit.robot} ended {stop.action.value} in cell {visit.cell}"
        )
        if ended.state is TaskState.HELD and not ended.is_loaded:
            ended = replace(ended, robot="", revision=ended.revision + 1)
            self._book.emit(ended, "left", now, text=f"{visit.robot} is free; {task.id} stays held")
        elif ended.state is TaskState.SUSPENDED and ended.question:
            self._asked[task.number] = ended.position
            reason = ended.reason.replace(_bond(task), _bond(ended), 1)
            ended = replace(ended, reason=reason, revision=ended.revision + 1)
            self._book.emit(ended, "question", now, text=ended.question)
        return ended

    def _is_over(
        self, task: Task, stop: Stop, visit: StopVisit, now: float, robot: RobotFacts | None
    ) -> bool:
        if task.state is TaskState.CANCELLING and not stop.moves_load:
            return True
        if stop.confirm and not task.confirmed:
            return False
        if _fills_battery(stop):
            if robot is None:  # it may be away for a moment only
                return False
            if robot.battery is None:
                return now - max(robot.moved_at, visit.started_at) >= BATTERY_WAIT_S
            return robot.battery >= self._charged
        duration = stop.duration
        if visit.stop == RETURN:
            duration = max((s.duration for s in task.order.stops if s.action is Action.DELIVER), default=0.0)
        return self._elapsed(visit.started_at, now) >= duration

    def _finish(self, task: Task, now: float) -> None:
        if task.state is TaskState.CANCELLING:
            has_returned = bool(task.visits) and task.visits[-1].stop == RETURN
            what = "brought its load away" if has_returned else "ended its action"
            self._book.advance(task, TaskCause.CANCEL, now, f"{task.robot} has {what}")
        elif task.state in (TaskState.RUNNING, TaskState.SUSPENDED):
            took = now - (task.started_at if task.started_at is not None else now)
            self._book.advance(task, TaskCause.FINISH, now, f"{task.robot} made all stops in {took:.0f} s")

    # Robots that cannot go on

    def _waited(self, task: Task, robot: RobotFacts, now: float) -> float:
        """Return for how long a robot has tried in vain to come nearer to its stop, as far as is known."""
        tried = self._tried_since.get(task.number, 0.0)
        return now - max(robot.moved_at, task.changed_at, tried, self._silent_until)

    def _check_trouble(self, task: Task, robot: RobotFacts, now: float, facts: FleetFacts) -> None:
        waited = self._waited(task, robot, now)
        if task.target in facts.shut and waited > self._rules.unreachable_after:
            self._give_up(task, now, f"cell {task.target} is blocked")
        elif robot.state == "unreachable" and waited > self._rules.unreachable_after:
            self._give_up(task, now, f"no path leads {robot.id} to cell {task.target}")
        elif waited > self._rules.stuck_after:
            why = f": {robot.reason}" if robot.reason else ""
            self._give_up(task, now, f"{robot.id} has not left cell {robot.cell} for {waited:.0f} s{why}")

    def _miss(self, task: Task, robot: RobotFacts | None, now: float, facts: FleetFacts) -> None:
        """Decide about a task whose robot does not answer."""
        if not task.is_bound and (task.state is TaskState.CANCELLING or task.next_stop is None):
            self._finish(task, now)
            return
        if not facts.is_live:
            return
        if robot is None:
            waited = self._elapsed(self._unknown_since.setdefault(task.robot, now), now)
            reason = f"{task.robot} is not known to the planner"
        else:
            waited = now - robot.away_since
            reason = f"{task.robot} is {robot.state}: {robot.reason or 'it has no pose'}"
        if waited > self._rules.lost_after or self._book.entry(task.robot).is_out:
            self._give_up(task, now, reason, is_away=True)

    def _give_up(self, task: Task, now: float, reason: str, *, is_away: bool = False) -> None:
        """Give a task to others, or end it if nothing is left; a bound one waits, and then fails."""
        self.avoid[task.number, task.robot] = now + self._rules.avoid_for
        if (visit := task.action) is not None:
            stop = _stop_of_visit(task, visit)
            is_cancelled = is_away and task.state is TaskState.CANCELLING
            # A robot that is only silent may be moving the load now: that takes its time.
            can_end = not stop.moves_load or self._book.entry(task.robot).is_out
            if _fills_battery(stop) or (is_cancelled and can_end):
                task = self._acted(task, stop, visit, now, is_given=not is_cancelled)
        if not task.is_bound:
            if task.state is TaskState.CANCELLING:
                self._book.advance(task, TaskCause.CANCEL, now, reason)
            elif task.next_stop is None:
                self._finish(task, now)
            else:
                self._book.advance(task, TaskCause.RELEASE, now, reason, robot="", target=None)
            return
        what = _bond(task)
        if task.state is TaskState.RUNNING:
            self._suspend(task, now, f"{what}: {reason}", is_away=is_away)
        elif self._elapsed(task.changed_at, now) > self._rules.load_lost_after:
            self._book.advance(task, TaskCause.FAIL, now, f"{what}; it did not come back: {reason}")
        elif task.state is TaskState.CANCELLING and task.action is None and not task.is_stranded:
            self._strand(task, now, f"{what}: {reason}", is_away=is_away)
        elif is_away and task.action is None and task.target is not None:
            waits = replace(task, target=None, revision=task.revision + 1)
            self._book.emit(waits, "waits", now, text=f"{what}: {reason}")

    def _suspend(self, task: Task, now: float, text: str, *, is_away: bool) -> None:
        """Suspend a task; ask people for its load: once for each stop, and each time its robot is away."""
        target = None if task.action is None else task.target  # others can use its cell meanwhile
        suspended = self._book.advance(task, TaskCause.SUSPEND, now, text, target=target)
        if not is_away and task.is_loaded:
            self._retry_at[task.number] = now + self._rules.unreachable_after
        if suspended.question and (is_away or self._asked.get(task.number) != task.position):
            self._asked[task.number] = task.position
            self._book.emit(suspended, "question", now, text=suspended.question)

    def _strand(self, task: Task, now: float, text: str, *, is_away: bool) -> None:
        """Ask people for the load of a cancelled task: once, and each time its robot is away."""
        stranded = replace(task, is_stranded=True, target=None, revision=task.revision + 1, reason=text)
        if not is_away:
            self._retry_at[task.number] = now + self._rules.unreachable_after
        if is_away or self._asked.get(task.number) != RETURN:
            self._asked[task.number] = RETURN
            self._book.emit(stranded, "question", now, text=stranded.question)
        else:
            self._book.emit(stranded, "waits", now, text=text)


def _bond(task: Task) -> str:
    """Return why only its present robot can continue a task, in words."""
    return f"its load is on {task.robot}" if task.is_loaded else f"{task.robot} acts for it"


def _stop_of_visit(task: Task, visit: StopVisit) -> Stop:
    return Stop(Action.DELIVER) if visit.stop == RETURN else task.order.stop(visit.stop)


def _fills_battery(stop: Stop) -> bool:
    """Return whether a stop ends by the battery, and not after a time."""
    return stop.action is Action.CHARGE and not stop.duration
