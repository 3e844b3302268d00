"""Tasks carried out by robots that move a cell a second: assignment, loads, trouble, restarts."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rce_fleet.exceptions import TaskRefusedError
from rce_fleet.planning.grid import GridMap
from rce_fleet.tasks.loads import settle_load
from rce_fleet.tasks.order import Action, Order, Stop, WhenLate
from rce_fleet.tasks.records import Places, RobotEntry, RobotProfile
from rce_fleet.tasks.task import RETURN, Task, TaskState

from .conftest import Floor


def test_robots_take_the_tasks_with_the_shortest_ways(floor: Floor) -> None:
    """The nearest robot of the first task is the only near one of the second."""
    floor.add("Robot1", 0)
    floor.add("Robot2", 4)
    near_both, far = floor.go(3), floor.go(7)
    floor.run(1)
    assert (floor.task(near_both).robot, floor.task(far).robot) == ("Robot1", "Robot2")


def test_priority_age_and_deadline_come_first(floor: Floor) -> None:
    floor.add("Robot1", 0)
    floor.go(1)
    urgent = floor.go(63, priority=1)
    floor.run(1)
    assert floor.task(urgent).state is TaskState.RUNNING
    other = Floor()
    other.add("Robot1", 0)
    other.go(1)
    due = other.go(63, deadline=other.now + 60)
    other.run(1)
    assert other.task(due).state is TaskState.RUNNING


@pytest.mark.parametrize("deadline", [-1e308, 1e308])
def test_extreme_deadlines_leave_costs_finite(floor: Floor, deadline: float) -> None:
    floor.add("Robot1", 0)
    task = floor.go(3, deadline=deadline)
    other = floor.go(5)
    floor.run_until_ended(task, other)
    assert floor.task(other).state is TaskState.DONE


def test_many_tasks_are_done_once_each(floor: Floor) -> None:
    for number, cell in enumerate((0, 7, 56, 63), 1):
        floor.add(f"Robot{number}", cell)
    tasks = [floor.deliver(8 + number % 16, 40 + number % 8) for number in range(24)]
    floor.run_until_ended(*tasks)
    for task in map(floor.task, tasks):
        assert task.state is TaskState.DONE
        assert [visit.stop for visit in task.visits] == [0, 1]
    assigned = [event for event in floor.events if event.name == "assigned"]
    assert assigned, "no task was put into the queue of a busy robot"


def test_a_held_robot_keeps_its_load_and_continues(floor: Floor) -> None:
    robot = floor.add("Robot1", 0)
    task = floor.deliver(2, 20)
    floor.run(8)
    assert floor.task(task).loads == 1
    floor.book.hold(task.id, floor.now)
    floor.run(3)
    cell = robot.cell
    floor.run(20)
    assert (robot.cell, robot.goal, floor.task(task).robot) == (cell, None, "Robot1")
    other = floor.go(0)
    floor.run(5)
    assert floor.task(other).state is TaskState.QUEUED
    floor.book.resume(task.id, floor.now)
    floor.run_until_ended(task, other)
    assert floor.task(task).state is TaskState.DONE


def test_a_held_robot_without_load_is_free(floor: Floor) -> None:
    floor.add("Robot1", 0)
    task, other = floor.go(63), floor.go(62)
    floor.run(2)
    running = next(each for each in (task, other) if floor.task(each).state is TaskState.RUNNING)
    waiting = task if running is other else other
    floor.book.hold(running.id, floor.now)
    floor.run_until_ended(waiting)
    assert floor.task(running).state is TaskState.HELD
    floor.book.resume(running.id, floor.now)
    floor.run_until_ended(running)


@pytest.mark.parametrize(("returns", "places", "cell"), [((33,), (), 33), ((), (34,), 34), ((), (), 2)])
def test_a_cancelled_load_is_brought_away(
    floor: Floor, returns: tuple[int, ...], places: tuple[int, ...], cell: int
) -> None:
    """It goes to the task's return cell, else of the fleet, else where it came from."""
    floor.book.emit(Places(returns=places), "places", floor.now)
    floor.add("Robot1", 0)
    task = floor.deliver(2, 63, return_cells=returns)
    floor.run(10)
    floor.book.cancel(task.id, floor.now)
    assert floor.task(task).state is TaskState.CANCELLING
    floor.run_until_ended(task)
    ended = floor.task(task)
    assert (ended.state, ended.loads) == (TaskState.CANCELLED, 0)
    assert (ended.visits[-1].stop, ended.visits[-1].cell) == (-1, cell)
    assert floor.book.task_of("Robot1") is None


def test_an_action_ends_before_a_cancelled_task_does(floor: Floor) -> None:
    floor.add("Robot1", 2)
    task = floor.deliver(2, 20, seconds=30.0)
    floor.run(5)
    floor.book.cancel(task.id, floor.now)
    floor.run_until_ended(task)
    ended = floor.task(task)
    assert [visit.stop for visit in ended.visits] == [0, -1]
    assert (ended.visits[0].ended_at or 0) - ended.visits[0].started_at >= 30.0


def test_a_silent_robots_task_goes_to_another(floor: Floor) -> None:
    first = floor.add("Robot1", 0)
    floor.add("Robot2", 63)
    task = floor.go(5, 6)
    floor.run(2)
    first.state, first.away_since = "silent", floor.now
    floor.run(10)
    assert floor.task(task).robot == "Robot1"
    floor.run_until_ended(task)
    assert (floor.task(task).state, floor.task(task).robot) == (TaskState.DONE, "Robot2")


def test_a_load_stays_with_a_silent_robot(floor: Floor) -> None:
    first = floor.add("Robot1", 0)
    floor.add("Robot2", 63)
    task = floor.deliver(1, 20)
    floor.run(6)
    first.state, first.away_since = "silent", floor.now
    floor.run(60)
    waiting = floor.task(task)
    assert (waiting.state, waiting.robot) == (TaskState.SUSPENDED, "Robot1")
    assert "its load is on Robot1" in waiting.reason
    first.state, first.away_since = "idle", float("inf")
    floor.run_until_ended(task)
    assert floor.task(task).state is TaskState.DONE


def test_a_load_that_does_not_come_back_fails(floor: Floor) -> None:
    first = floor.add("Robot1", 0)
    task = floor.deliver(1, 20)
    floor.run(6)
    first.state, first.away_since = "silent", floor.now
    floor.run_until_ended(task, most=4000)
    assert floor.task(task).state is TaskState.FAILED
    assert floor.book.task_of("Robot1") is None


def test_a_stuck_robots_task_goes_to_another(floor: Floor) -> None:
    floor.add("Robot1", 0)
    floor.add("Robot2", 63)
    floor.stuck = {"Robot1"}
    task = floor.go(5)
    floor.run_until_ended(task)
    assert floor.task(task).robot == "Robot2"
    assert any("has not left cell 0" in event.text for event in floor.events)


@pytest.mark.parametrize("mode", ["dead", "out_of_service"])
def test_a_robot_taken_out_gives_its_task_away(floor: Floor, mode: str) -> None:
    floor.add("Robot1", 0)
    floor.add("Robot2", 63)
    task = floor.go(5)
    floor.run(1)
    floor.book.emit(RobotEntry("Robot1", mode=mode), "taken out", floor.now)
    floor.run(2)
    assert floor.task(task).robot == "Robot2"
    assert floor.dispatcher.goals()["Robot1"] is None


def test_a_task_is_taken_from_its_robot(floor: Floor) -> None:
    """Another robot does it, although the first one is nearer; a loaded robot keeps it."""
    floor.add("Robot1", 0)
    floor.add("Robot2", 63)
    task = floor.go(5)
    floor.run(1)
    assert floor.book.reassign(task.id, floor.now, user="anna").state is TaskState.QUEUED
    floor.dispatcher.avoid(task, "Robot1", floor.now)
    floor.run_until_ended(task)
    assert floor.task(task).robot == "Robot2"
    loaded = floor.deliver(1, 20, seconds=30.0)
    floor.run(10)
    with pytest.raises(TaskRefusedError, match=f"Robot1 has the load of {loaded.id}"):
        floor.book.reassign(loaded.id, floor.now)
    with pytest.raises(TaskRefusedError, match="is done"):
        floor.book.reassign(task.id, floor.now)


@pytest.mark.parametrize("state", ["paused", "stopped", "manual"])
def test_a_halted_robot_keeps_its_task(floor: Floor, state: str) -> None:
    """However long; and no halted robot begins with another one."""
    first, second = floor.add("Robot1", 0), floor.add("Robot2", 63)
    task = floor.go(5)
    floor.run(2)
    for robot in (first, second):
        robot.state, robot.away_since = state, floor.now  # away, so that the floor does not move it
    other = floor.go(20)
    floor.run(400)
    assert (floor.task(task).robot, floor.task(task).state) == ("Robot1", TaskState.RUNNING)
    assert floor.task(other).state in (TaskState.QUEUED, TaskState.ASSIGNED)


def test_two_tasks_share_a_cell_one_by_one(floor: Floor) -> None:
    floor.add("Robot1", 0)
    floor.add("Robot2", 7)
    tasks = [floor.book.create(Order((Stop(Action.GO, (20,), 10.0),)), floor.now) for _ in range(2)]
    floor.run(9)
    assert any("waits for cell 20, which" in floor.task(task).reason for task in tasks)
    floor.run_until_ended(*tasks)
    ends = sorted((visit.started_at, visit.ended_at) for task in tasks for visit in floor.task(task).visits)
    assert ends[0][1] is not None
    assert ends[1][0] >= ends[0][1]


def test_conditions_of_the_start_are_kept(floor: Floor) -> None:
    floor.add("Robot1", 0)
    later = floor.go(1, earliest_start=floor.now + 30)
    second = floor.go(2, after=(later.id,))
    floor.run(20)
    assert floor.task(later).reason == "waits for its earliest start"
    assert floor.task(second).reason == f"waits for {later.id}"
    floor.run_until_ended(second)
    assert (floor.task(second).started_at or 0) >= floor.task(later).changed_at
    assert (floor.task(later).started_at or 0) >= later.created_at + 30


def test_a_task_fails_with_the_one_before_it(floor: Floor) -> None:
    first = floor.go(1, earliest_start=floor.now + 30)
    second = floor.go(2, after=(first.id,))
    floor.book.cancel(first.id, floor.now)
    floor.run(1)
    assert floor.task(second).state is TaskState.FAILED
    assert f"{first.id}, which must be done before, is cancelled" in floor.task(second).reason


def test_deadlines_are_noted_or_end_a_task(floor: Floor) -> None:
    late = floor.go(1, deadline=floor.now + 5)
    gone = floor.go(1, deadline=floor.now + 5, when_late=WhenLate.FAIL)
    floor.run(10)
    assert (floor.task(late).late, floor.task(late).state) == (True, TaskState.QUEUED)
    assert floor.task(gone).state is TaskState.FAILED


@pytest.mark.parametrize("is_sent", [False, True])
def test_a_held_task_that_none_began_fails_at_its_deadline(floor: Floor, is_sent: bool) -> None:
    """A robot that was only on its way has not begun; a robot that holds a load keeps the task."""
    gone = floor.go(63, deadline=floor.now + 5, when_late=WhenLate.FAIL)
    rule = {"deadline": floor.now + 8, "when_late": WhenLate.FAIL}
    loaded = floor.deliver(1, 20, 1.0, priority=1, **rule)
    floor.add("Robot1", 0)
    floor.run(1)
    assert floor.task(loaded).robot == "Robot1"
    if is_sent:
        floor.add("Robot2", 40)
        floor.run(1)
        assert floor.task(gone).state is TaskState.RUNNING
    floor.book.hold(gone.id, floor.now)
    floor.run(2)
    assert floor.task(gone).state is TaskState.HELD
    floor.run(2)
    floor.book.hold(loaded.id, floor.now)
    floor.run(6)
    assert (floor.task(gone).state, floor.task(gone).late) == (TaskState.FAILED, True)
    assert "its deadline passed" in floor.task(gone).reason
    assert (floor.task(loaded).state, floor.task(loaded).late) == (TaskState.HELD, True)


def test_a_task_recurs_without_piling_up(floor: Floor) -> None:
    first = floor.go(1, every=10.0, occurrences=3)
    floor.run(45)  # no robot: occurrences that are due wait
    assert len(floor.book.tasks) == 1
    floor.add("Robot1", 0)
    floor.run(60)
    tasks = sorted(floor.book.tasks.values(), key=lambda task: task.number)
    assert [task.occurrence for task in tasks] == [1, 2, 3]
    assert all(task.state is TaskState.DONE for task in tasks)
    assert floor.task(first).recurs_at is None


@pytest.mark.parametrize(
    ("given", "changed", "number", "recurs_in"),
    [
        ((10.0, 10), (10.0, 1), 1, None),
        ((10.0, 3), (10.0, 20), 3, 10.0),
        ((10.0, 3), (25.0, 3), 3, None),
        ((10.0, 3), (25.0, 4), 3, 26.0),
        ((10.0, 3), (25.0, 3), 2, 26.0),
        ((10.0, None), (10.0, None), 2, 10.0),
        ((10.0, 3), (None, None), 1, None),
        ((None, None), (10.0, 2), 1, 11.0),
    ],
)
def test_a_change_of_the_recurrence_respects_its_count(
    floor: Floor,
    given: tuple[float | None, int | None],
    changed: tuple[float | None, int | None],
    number: int,
    recurs_in: float | None,
) -> None:
    """The occurrence was created when it was due; its task is changed a second later."""
    task = floor.go(1, every=given[0], occurrences=given[1])
    while task.occurrence < number:
        floor.book.put_record(replace(task, state=TaskState.DONE))
        floor.now += 10.0
        task = floor.book.recur(floor.task(task), floor.now)
    begun = floor.now
    order = replace(task.order, every=changed[0], occurrences=changed[1], name="changed")
    task = floor.book.change(task.id, order, begun + 1.0)
    assert task.recurs_at == (None if recurs_in is None else begun + recurs_in)


@pytest.mark.parametrize(
    ("order", "reason"),
    [
        ({"payload": 80.0}, "no robot that may do it carries 80 kg: the strongest, Robot2, carries 50 kg"),
        ({"capabilities": ("fork",)}, "no robot has all of the capabilities fork"),
        ({"robot": "Robot9"}, "only Robot9 may do it, which is not in service"),
        ({}, "no path leads any robot to all of its stops (cells 63)"),
    ],
)
def test_a_task_that_no_robot_can_do_says_why(order: dict[str, object], reason: str) -> None:
    floor = Floor(GridMap(blocked=frozenset({54, 55, 62})))
    floor.add("Robot1", 0)
    floor.add("Robot2", 1)
    floor.book.emit(RobotEntry("Robot2", profile=RobotProfile(payload=50.0)), "profile", floor.now)
    task = floor.go(63 if not order else 5, **order)
    floor.run(3)
    assert floor.task(task).reason == reason


def test_an_action_is_not_begun_again_after_a_restart(floor: Floor) -> None:
    """The manager is away during an action: it ends when its time has passed, and is there once."""
    floor.add("Robot1", 2)
    task = floor.deliver(2, 20, seconds=30.0)
    floor.run(5)
    assert floor.task(task).action is not None
    floor.restart()
    floor.now += 300
    floor.run_until_ended(task)
    assert [visit.stop for visit in floor.task(task).visits] == [0, 1]


def test_a_confirmed_stop_waits(floor: Floor) -> None:
    floor.add("Robot1", 0)
    task = floor.book.create(Order((Stop(Action.GO, (1,), confirm=True),)), floor.now)
    floor.run(50)
    assert floor.task(task).action is not None
    floor.book.confirm(task.id, floor.now)
    floor.run_until_ended(task)


NAMES = ("Robot1", "Robot2", "Robot3")


class Shift:
    """A floor on which things happen at random."""

    def __init__(self) -> None:
        self.floor = Floor()
        self.tasks: list[Task] = []
        for name, cell in zip(NAMES, (0, 7, 56), strict=True):
            self.floor.add(name, cell)

    def happen(self, what: str, first: int, second: int) -> None:
        """Let one thing happen, with two numbers that say where or to whom."""
        floor = self.floor
        still_open = [task for task in self.tasks if not floor.task(task).has_ended]
        if what == "post":
            self.tasks.append(floor.deliver(8 + first, 32 + second))
        elif what == "restart":
            floor.restart()
        elif what == "lose":
            robot = floor.facts.robots[NAMES[first % len(NAMES)]]
            is_away = robot.state == "silent"
            robot.state = "idle" if is_away else "silent"
            robot.away_since = float("inf") if is_away else floor.now
        elif what == "block":
            self.block(8 + first + second)
        elif still_open:
            task = floor.task(still_open[first % len(still_open)])
            if task.state is not TaskState.CANCELLING:
                getattr(floor.book, what)(task.id, floor.now)

    def block(self, *cells: int) -> None:
        self.floor.facts.shut = frozenset(cells)
        self.floor.facts.map_revision += 1

    def end(self) -> None:
        """Let everything work again, until all tasks have ended."""
        self.floor.restart()
        self.block()
        for robot in self.floor.facts.robots.values():
            robot.state, robot.away_since = "idle", float("inf")
        for task in self.tasks:
            if self.floor.task(task).state is TaskState.HELD:
                self.floor.book.resume(task.id, self.floor.now)
        self.floor.run_until_ended(*self.tasks, most=4000)


_THINGS = st.tuples(
    st.sampled_from(["post", "post", "hold", "resume", "cancel", "restart", "lose", "block"]),
    st.integers(0, 22),
    st.integers(0, 22),
    st.integers(1, 40),
)


@settings(max_examples=20, deadline=None)
@given(st.lists(_THINGS, min_size=5, max_size=25))
def test_no_task_is_lost_or_done_twice(things: list[tuple[str, int, int, int]]) -> None:
    """Restarts, holds, cancellations, silence and blocked cells at random moments."""
    shift = Shift()
    for what, first, second, seconds in things:
        shift.happen(what, first, second)
        shift.floor.run(seconds)
    shift.end()
    for task in map(shift.floor.task, shift.tasks):
        assert task.state in (TaskState.DONE, TaskState.CANCELLED)
        assert task.loads == 0
        stops = [visit.stop for visit in task.visits]
        assert task.state is TaskState.CANCELLED or stops == [0, 1]
        assert len(set(stops)) == len(stops)
        assert all(visit.ended_at is not None for visit in task.visits)
    assert all(shift.floor.book.task_of(name) is None for name in NAMES)


def _vanish_with_load(floor: Floor) -> Task:
    """Let a robot pick a load, and be silent from then on."""
    robot = floor.add("Robot1", 0)
    task = floor.deliver(3, 60)
    while not floor.task(task).is_loaded:
        floor.run(1)
    robot.state, robot.reason, robot.away_since = "silent", "no messages", floor.now
    floor.run(20)
    assert floor.task(task).state is TaskState.SUSPENDED
    return task


def test_people_are_asked_where_a_vanished_load_is(floor: Floor) -> None:
    task = _vanish_with_load(floor)
    assert "Where is the load that Robot1 has" in floor.task(task).question
    assert [event.name for event in floor.events].count("question") == 1
    floor.add("Robot2", 63)
    settled = settle_load(floor.book, task.id, 20, floor.now, user="anna")
    assert (settled.state, settled.question) == (TaskState.QUEUED, "")
    floor.run_until_ended(task)
    ended = floor.task(task)
    assert (ended.state, ended.loads) == (TaskState.DONE, 0)
    assert [(visit.robot, visit.cell) for visit in ended.visits] == [
        *(("Robot1", 3), ("Robot2", 20), ("Robot2", 60)),
    ]


def test_a_lost_load_fails_its_task(floor: Floor) -> None:
    task = _vanish_with_load(floor)
    settle_load(floor.book, task.id, None, floor.now, user="anna")
    assert (floor.task(task).state, floor.task(task).reason) == (
        *(TaskState.FAILED, "its load is lost, says anna"),
    )
    with pytest.raises(TaskRefusedError, match="is failed"):
        settle_load(floor.book, task.id, 20, floor.now)


def test_a_found_load_ends_a_cancelled_task(floor: Floor) -> None:
    task = _vanish_with_load(floor)
    floor.book.cancel(task.id, floor.now)
    assert floor.task(task).state is TaskState.CANCELLING
    settle_load(floor.book, task.id, 20, floor.now)
    assert floor.task(task).state is TaskState.CANCELLED


def test_the_load_of_a_robot_that_drives_stays(floor: Floor) -> None:
    floor.add("Robot1", 0)
    task = floor.deliver(3, 60)
    floor.run(2)
    with pytest.raises(TaskRefusedError, match="T1 is running"):
        settle_load(floor.book, task.id, 20, floor.now)


def test_a_robot_taken_out_ends_its_action(floor: Floor) -> None:
    """Its task has nothing left then."""
    floor.add("Robot1", 0)
    task = floor.book.create(Order((Stop(Action.GO, (2,), 30.0),)), floor.now)
    floor.run(5)
    floor.book.emit(RobotEntry("Robot1", mode="out_of_service"), "taken out", floor.now)
    floor.run(2)
    assert floor.task(task).state is TaskState.SUSPENDED
    floor.run_until_ended(task, most=60)
    assert floor.task(task).state is TaskState.DONE


def _vanish_acting(floor: Floor) -> Task:
    """Let a robot act at the only stop for half a minute, and be silent from then on."""
    robot = floor.add("Robot1", 0)
    task = floor.book.create(Order((Stop(Action.GO, (2,), 30.0),)), floor.now)
    while floor.task(task).action is None:
        floor.run(1)
    robot.state, robot.reason, robot.away_since = "silent", "no messages", floor.now
    floor.run(20)
    assert floor.task(task).state is TaskState.SUSPENDED
    return task


def test_a_last_action_ends_while_its_robot_is_away(floor: Floor) -> None:
    """All stops were made: the task is done, and the robot has none."""
    task = _vanish_acting(floor)
    assert floor.task(task).reason == "Robot1 acts for it: Robot1 is silent: no messages"
    floor.run_until_ended(task, most=20)
    assert floor.task(task).state is TaskState.DONE
    assert floor.book.task_of("Robot1") is None


def test_an_action_that_ends_while_away_frees_the_task(floor: Floor) -> None:
    """Another robot makes the stops that are left."""
    robot = floor.add("Robot1", 0)
    stops = (Stop(Action.GO, (2,), 30.0), Stop(Action.GO, (5,)))
    task = floor.book.create(Order(stops), floor.now)
    while floor.task(task).action is None:
        floor.run(1)
    robot.state, robot.away_since = "silent", floor.now
    floor.add("Robot2", 63)
    floor.run_until_ended(task, most=120)
    assert floor.task(task).state is TaskState.DONE
    assert [visit.robot for visit in floor.task(task).visits] == ["Robot1", "Robot2"]


def test_a_suspended_task_can_be_cancelled_in_each_moment(floor: Floor) -> None:
    """Also between the end of its action and the next step."""
    task = _vanish_acting(floor)
    visit = floor.task(task).visits[-1]
    ended = replace(floor.task(task), visits=(replace(visit, ended_at=floor.now),), position=1)
    floor.book.put_record(ended)
    assert floor.book.cancel(task.id, floor.now).state is TaskState.CANCELLED
    assert floor.book.task_of("Robot1") is None


@pytest.mark.parametrize("how", ["held", "changed"])
def test_a_task_whose_stops_were_all_made_is_done(floor: Floor, how: str) -> None:
    """No robot has to begin with it to find out that nothing is left."""
    robot = floor.add("Robot1", 0)
    stops = (Stop(Action.GO, (2,), 10.0), Stop(Action.GO, (5,)))
    task = floor.book.create(Order(stops[:1] if how == "held" else stops), floor.now)
    floor.run(5)
    floor.book.hold(task.id, floor.now)
    floor.run(20)
    robot.state, robot.away_since = "silent", floor.now
    if how == "changed":
        floor.book.change(task.id, Order(stops[:1]), floor.now)
    floor.book.resume(task.id, floor.now)
    floor.run(2)
    assert floor.task(task).state is TaskState.DONE


@pytest.mark.parametrize("is_on_its_way", [False, True])
@pytest.mark.parametrize("answer", ["freed", "told"])
def test_a_load_without_a_path_is_asked_for_until_it_is_settled(
    floor: Floor, answer: str, *, is_on_its_way: bool
) -> None:
    """The question was there for one step; then the task ran, with a robot that stood still."""
    floor.add("Robot1", 0)
    task = floor.deliver(3, 60)
    while floor.task(task).target != (60 if is_on_its_way else 3):
        floor.run(1)
    floor.facts.shut, floor.facts.map_revision = frozenset({60}), 1
    floor.run(60)
    events = len(floor.events)
    floor.run(300)
    assert (floor.task(task).state, floor.task(task).loads) == (TaskState.SUSPENDED, 1)
    assert "Where is the load that Robot1 has?" in floor.task(task).question
    assert len(floor.events) == events
    assert [event.name for event in floor.events].count("question") == 1
    if answer == "told":
        settle_load(floor.book, task.id, 5, floor.now)
    floor.facts.shut, floor.facts.map_revision = frozenset(), 2
    floor.run_until_ended(task)
    assert floor.task(task).state is TaskState.DONE
    picked = [visit.cell for visit in floor.task(task).visits]
    assert picked == ([3, 5, 60] if answer == "told" else [3, 60])


def test_people_can_answer_for_a_load_while_its_robot_is_stuck(floor: Floor) -> None:
    """It tries again and again; they are asked once, and have time to say where the load is."""
    floor.add("Robot1", 0)
    task = floor.deliver(3, 60)
    while not floor.task(task).is_loaded:
        floor.run(1)
    floor.stuck.add("Robot1")
    states = []
    for _ in range(600):
        floor.run(1)
        states.append(floor.task(task).state)
    names = [event.name for event in floor.events]
    assert states.count(TaskState.SUSPENDED) >= 60
    assert names.count("continued") >= 3
    assert names.count("question") == 1
    while floor.task(task).state is not TaskState.SUSPENDED:
        floor.run(1)
    floor.run(5)
    settle_load(floor.book, task.id, 5, floor.now)
    floor.stuck.clear()
    floor.run_until_ended(task)
    assert floor.task(task).state is TaskState.DONE


@pytest.mark.parametrize("is_cancelled", [False, True])
def test_a_dead_robot_with_a_load_keeps_no_cell(floor: Floor, *, is_cancelled: bool) -> None:
    """Others go to the cell to which it was on its way."""
    robot = floor.add("Robot1", 0)
    task = floor.deliver(3, 60, return_cells=(20,))
    while not floor.task(task).is_loaded:
        floor.run(1)
    if is_cancelled:
        floor.book.cancel(task.id, floor.now)
    floor.run(2)
    target = 20 if is_cancelled else 60
    assert floor.task(task).target == target
    robot.state, robot.away_since = "dead", floor.now
    floor.book.emit(RobotEntry("Robot1", mode="dead"), "dead", floor.now)
    floor.add("Robot2", 63)
    other = floor.go(target)
    floor.run_until_ended(other, most=60)
    assert (floor.task(task).target, floor.task(task).loads) == (None, 1)
    events = len(floor.events)
    floor.run(5)
    assert len(floor.events) == events
    floor.book.emit(RobotEntry("Robot1"), "put in", floor.now)
    robot.state, robot.away_since = "idle", float("inf")
    floor.run_until_ended(task)
    assert floor.task(task).loads == 0


@pytest.mark.parametrize("action", [Action.GO, Action.PARK, Action.CHARGE])
def test_a_cancelled_task_ends_with_a_dead_robot(floor: Floor, action: Action) -> None:
    """It has no load, and the robot does nothing at the stop whose end would count."""
    robot = floor.add("Robot1", 0)
    task = floor.book.create(Order((Stop(action, (2,), 7200.0, confirm=True),)), floor.now)
    floor.run(5)
    robot.state, robot.away_since = "dead", floor.now
    floor.book.emit(RobotEntry("Robot1", mode="dead"), "dead", floor.now)
    floor.run(2)
    assert floor.task(task).state is TaskState.SUSPENDED
    floor.book.cancel(task.id, floor.now)
    floor.run(2)
    assert floor.task(task).state is TaskState.CANCELLED
    assert floor.book.task_of("Robot1") is None


@pytest.mark.parametrize("stop", [0, 1, RETURN])
def test_a_cancelled_task_asks_for_the_load_of_a_dead_robot_at_once(floor: Floor, stop: int) -> None:
    """A robot that died while it takes a load or gives it away may have it; the task waited for two hours."""
    robot = floor.add("Robot1", 0)
    seconds = (7200.0 if stop == 0 else 1.0, 1.0 if stop == 0 else 7200.0)
    stops = (Stop(Action.PICK, (2,), seconds[0]), Stop(Action.DELIVER, (5,), seconds[1]))
    task = floor.book.create(Order(stops), floor.now)
    if stop == RETURN:
        while floor.task(task).loads == 0:
            floor.run(1)
        floor.book.cancel(task.id, floor.now)
    floor.run(15)
    assert floor.task(task).visits[-1].stop == stop
    assert floor.task(task).action is not None
    robot.state, robot.away_since = "dead", floor.now
    floor.book.emit(RobotEntry("Robot1", mode="dead"), "dead", floor.now)
    floor.run(1)
    floor.book.cancel(task.id, floor.now)
    floor.run(1)
    assert (floor.task(task).state, floor.task(task).action) == (TaskState.CANCELLING, None)
    assert floor.task(task).loads == 1
    settle_load(floor.book, task.id, 2, floor.now)
    assert floor.task(task).state is TaskState.CANCELLED
    assert floor.book.task_of("Robot1") is None


@pytest.mark.parametrize("state", ["silent", "unknown"])
def test_a_cancelled_pick_of_a_silent_robot_takes_its_time(floor: Floor, state: str) -> None:
    """It may be lifting the load now, and drives away with it when it is heard again."""
    robot = floor.add("Robot1", 0)
    task = floor.deliver(2, 20, 60.0)
    floor.run(5)
    assert floor.task(task).action is not None
    if state == "silent":
        robot.state, robot.away_since = state, floor.now
    else:
        del floor.facts.robots["Robot1"]
    floor.book.cancel(task.id, floor.now)
    floor.run(30)
    assert floor.task(task).action is not None
    floor.run(40)
    assert (floor.task(task).action, floor.task(task).loads) == (None, 1)


@pytest.mark.parametrize("seconds", [0.0, 7200.0])
def test_a_cancelled_task_charges_no_further(floor: Floor, seconds: float) -> None:
    """Also at a charger that gives nothing: the robot would stand there without end."""
    floor.add("Robot1", 0, battery=0.3)
    task = floor.book.create(Order((Stop(Action.CHARGE, (2,), seconds),)), floor.now)
    floor.run(5)
    assert floor.task(task).action is not None
    floor.book.cancel(task.id, floor.now)
    floor.run(2)
    assert floor.task(task).state is TaskState.CANCELLED


_LOSSES = st.tuples(
    st.sampled_from(["post", "go", "charge", "hold", "resume", "cancel", "restart", "lose", "kill", "block"]),
    st.integers(0, 22),
    st.integers(0, 22),
    st.integers(1, 40),
)


@settings(max_examples=20, deadline=None)
@given(st.lists(_LOSSES, min_size=5, max_size=25))
def test_people_can_end_each_task_whatever_happened(things: list[tuple[str, int, int, int]]) -> None:
    """At the end all robots are dead; tasks are cancelled, and their loads are said to be lost."""
    shift = Shift()
    floor = shift.floor
    for what, first, second, seconds in things:
        if what == "go":
            stop = Stop(Action.GO, (8 + first,), 300.0, confirm=second > 11)
            shift.tasks.append(floor.book.create(Order((stop,)), floor.now))
        elif what == "charge":
            shift.tasks.append(floor.book.create(Order((Stop(Action.CHARGE, (8 + first,)),)), floor.now))
        elif what == "kill":
            _kill(floor, NAMES[first % len(NAMES)])
        else:
            shift.happen(what, first, second)
        floor.run(seconds)
    for name in NAMES:
        _kill(floor, name)
    floor.run(5)
    for task in map(floor.task, shift.tasks):
        if not task.has_ended:
            floor.book.cancel(task.id, floor.now)
    floor.run(5)
    for task in map(floor.task, shift.tasks):
        if task.is_loaded and not task.has_ended and task.action is None:
            settle_load(floor.book, task.id, None, floor.now)
    floor.run(1)
    assert all(floor.task(task).has_ended for task in shift.tasks)
    assert all(floor.book.task_of(name) is None for name in NAMES)
    assert floor.dispatcher.goals() == dict.fromkeys(NAMES)


def _kill(floor: Floor, name: str) -> None:
    robot = floor.facts.robots[name]
    robot.state, robot.mode, robot.away_since = "dead", "dead", floor.now
    floor.book.emit(RobotEntry(name, mode="dead"), "dead", floor.now)


@pytest.mark.parametrize("state", [TaskState.CANCELLED, TaskState.DONE])
def test_a_task_of_which_nothing_is_left_needs_no_planner(floor: Floor, state: TaskState) -> None:
    """Its last action ends while the planner is away, with all robots."""
    floor.add("Robot1", 0)
    task = floor.book.create(Order((Stop(Action.GO, (2,), 30.0),)), floor.now)
    floor.run(5)
    floor.facts.is_live = False
    floor.facts.robots.clear()
    if state is TaskState.CANCELLED:
        floor.book.cancel(task.id, floor.now)
    floor.run(40)
    assert floor.task(task).state is state
