"""From lists of cells to goals."""

from __future__ import annotations

from math import pi

import pytest

from rce.ros.types import Time
from rce_fleet.coordination.answers import numbered_array, revision_of
from rce_fleet.coordination.move_client import (
    QUIET_TIME,
    REPEAT_AFTER,
    ClientReport,
    ClientState,
    GoalState,
    Instruction,
    MoveClient,
    SendGoal,
    SendStop,
)
from rce_fleet.planning.grid import GridMap


@pytest.fixture
def client() -> MoveClient:
    """A client whose robot is quiet; the time is 10."""
    made = MoveClient(GridMap(), "Robot1", 0.0)
    assert made.tick(0.0) == [SendStop(0.0)]
    made.take_goal_states({}, 1.0)
    made.take_goal_states({}, 1.0 + QUIET_TIME)
    assert made.report.state is ClientState.IDLE
    return made


def goal_of(instructions: list[Instruction]) -> SendGoal:
    (found,) = [done for done in instructions if isinstance(done, SendGoal)]
    return found


def state_of(client: MoveClient) -> ClientState:
    return client.report.state


def cells_sent(instructions: list[Instruction]) -> list[int]:
    return [done.cell for done in instructions if isinstance(done, SendGoal)]


def reach(client: MoveClient, goal: SendGoal, now: float = 11.0) -> list[Instruction]:
    return client.take_result(goal.id, GoalState.SUCCEEDED, now)


def test_first_cell_is_its_own_goal_then_straight_runs(client: MoveClient) -> None:
    goal = goal_of(client.take_cells(1, [0, 1, 2, 10, 18], 10.0))
    assert goal.cell == 0
    goal = goal_of(reach(client, goal))
    assert (goal.cell, goal.heading) == (2, 0.0)
    goal = goal_of(reach(client, goal))
    assert goal.cell == 18
    assert goal.heading == pytest.approx(pi / 2)
    done = reach(client, goal)
    assert cells_sent(done) == []
    assert client.report == ClientReport(1, ClientState.IDLE, (0, 1, 2, 10, 18), 18, None)


def test_a_longer_list_moves_the_goal_ahead_while_driving(client: MoveClient) -> None:
    goal = goal_of(reach(client, goal_of(client.take_cells(1, [0, 1, 2], 10.0))))
    assert goal.cell == 2
    farther = goal_of(client.take_cells(2, [1, 2, 3, 4, 12], 12.0))
    assert farther.cell == 4
    assert client.take_result(goal.id, GoalState.PREEMPTED, 12.1) == [], "the old goal means nothing now"
    assert goal_of(reach(client, farther)).cell == 12


def test_list_from_target_on_does_not_slow_robot(client: MoveClient) -> None:
    """A list that begins with the target does not slow the robot down."""
    reach(client, goal_of(client.take_cells(1, [0, 1, 2], 10.0)))
    assert cells_sent(client.take_cells(2, [2, 3, 4], 12.0)) == [4]


def test_a_list_that_turns_keeps_the_goal_until_it_is_reached(client: MoveClient) -> None:
    goal = goal_of(reach(client, goal_of(client.take_cells(1, [0, 1, 2], 10.0))))
    assert cells_sent(client.take_cells(2, [2, 10, 18], 12.0)) == []
    assert goal_of(reach(client, goal)).cell == 18


def test_goals_never_leave_the_list(client: MoveClient) -> None:
    cells = [7, 15, 14, 13, 21, 22, 23]
    goal = goal_of(client.take_cells(1, cells, 10.0))
    driven = [goal.cell]
    while True:
        done = reach(client, goal)
        if not cells_sent(done):
            break
        goal = goal_of(done)
        first, last = cells.index(driven[-1]), cells.index(goal.cell)
        steps = {b - a for a, b in zip(cells[first:last], cells[first + 1 : last + 1], strict=True)}
        assert len(steps) == 1, "straight on only"
        driven.append(goal.cell)
    assert driven == [7, 15, 13, 21, 23]


def test_an_older_or_known_list_is_ignored(client: MoveClient) -> None:
    client.take_cells(5, [0, 1], 10.0)
    assert client.take_cells(5, [8, 9], 10.1) == []
    assert client.take_cells(4, [8, 9], 10.1) == []
    assert client.report.cells == (0, 1)


def test_lists_without_number_count_when_they_differ(client: MoveClient) -> None:
    assert cells_sent(client.take_cells(None, [0, 1], 10.0)) == [0]
    assert client.take_cells(None, [0, 1], 10.5) == []
    assert client.take_cells(None, [1, 2], 11.0)
    assert client.report.cells == (1, 2)


def test_a_cancellation_stops_the_robot_and_drops_the_list(client: MoveClient) -> None:
    goal = goal_of(client.take_cells(1, [0, 1], 10.0))
    done = client.cancel(10.5)
    assert SendStop(10.5) in done
    assert client.report == ClientReport(1, ClientState.CANCELLING, (), None, None)
    assert client.take_goal_states({goal.id: GoalState.PREEMPTING}, 10.6) == []
    client.take_result(goal.id, GoalState.PREEMPTED, 10.7)
    assert state_of(client) is ClientState.IDLE


def test_an_empty_list_is_a_cancellation(client: MoveClient) -> None:
    client.take_cells(1, [0, 1], 10.0)
    assert SendStop(10.5) in client.take_cells(2, [], 10.5)
    assert client.report.revision == 2


def test_list_while_stopping_waits_for_standstill(client: MoveClient) -> None:
    """A list that comes while stopping waits until the robot stands."""
    goal = goal_of(client.take_cells(1, [0, 1], 10.0))
    client.cancel(10.5)
    assert cells_sent(client.take_cells(2, [8, 9], 10.6)) == []
    done = client.take_goal_states({goal.id: GoalState.PREEMPTED}, 10.7)
    assert cells_sent(done) == [8]


def test_a_list_without_the_target_stops_the_robot_first(client: MoveClient) -> None:
    goal = goal_of(reach(client, goal_of(client.take_cells(1, [0, 1, 2, 3], 10.0))))
    done = client.take_cells(2, [1, 9], 11.5)
    assert SendStop(11.5) in done
    assert cells_sent(client.take_result(goal.id, GoalState.PREEMPTED, 10.9)) == [1]


def test_a_lost_goal_is_sent_again_the_same(client: MoveClient) -> None:
    goal = goal_of(client.take_cells(1, [0, 1], 10.0))
    assert client.take_goal_states({}, 10.2) == []
    assert client.take_goal_states({}, 10.0 + REPEAT_AFTER) == [goal]
    assert client.take_goal_states({goal.id: GoalState.ACTIVE}, 13.0) == []


def test_a_lost_result_is_read_from_the_list_of_goals(client: MoveClient) -> None:
    goal = goal_of(client.take_cells(1, [0, 1], 10.0))
    assert cells_sent(client.take_goal_states({goal.id: GoalState.SUCCEEDED}, 10.4)) == [1]


def test_a_lost_cancellation_is_sent_again(client: MoveClient) -> None:
    goal = goal_of(client.take_cells(1, [0, 1], 10.0))
    client.cancel(10.5)
    client.take_goal_states({goal.id: GoalState.ACTIVE}, 10.9)
    assert client.tick(11.0) == []
    assert client.tick(10.5 + REPEAT_AFTER) == [SendStop(10.5 + REPEAT_AFTER)]


def test_goal_that_the_robot_never_received_times_out(client: MoveClient) -> None:
    client.take_cells(1, [0, 1], 10.0)
    client.cancel(10.5)
    client.take_goal_states({}, 10.6)
    assert state_of(client) is ClientState.CANCELLING
    client.take_goal_states({}, 10.6 + QUIET_TIME)
    assert state_of(client) is ClientState.IDLE


def test_goal_from_before_a_restart_is_waited_for() -> None:
    client = MoveClient(GridMap(), "Robot1", 0.0)
    assert client.take_goal_states({}, 5.0) == [SendStop(5.0)]
    client.take_goal_states({"old": GoalState.ACTIVE}, 5.5)
    client.take_goal_states({"old": GoalState.PREEMPTED}, 6.0)
    assert state_of(client) is ClientState.CANCELLING
    client.take_goal_states({"old": GoalState.PREEMPTED}, 6.0 + QUIET_TIME)
    assert state_of(client) is ClientState.IDLE


HOUR = 3600.0


def test_after_a_clock_step_back_a_stop_still_counts(client: MoveClient) -> None:
    """A robot does not stop for a cancellation that is older than its goal."""
    goal = goal_of(client.take_cells(1, [0, 1], 10_000.0))
    (stop, _) = client.cancel(10_001.0 - HOUR)
    assert isinstance(stop, SendStop)
    assert stop.stamp >= goal.stamp
    assert client.take_goal_states({goal.id: GoalState.ACTIVE}, 10_001.5 - HOUR) == []
    assert client.tick(10_001.0 + REPEAT_AFTER - HOUR) == [stop], "it was lost, perhaps"


def test_after_a_clock_step_back_new_goals_are_newer_than_stops(client: MoveClient) -> None:
    """A robot recalls a goal that is older than a cancellation."""
    goal = goal_of(client.take_cells(1, [0, 1], 10_000.0))
    (stop, _) = client.cancel(10_001.0)
    assert isinstance(stop, SendStop)
    client.take_goal_states({goal.id: GoalState.PREEMPTED}, 10_001.2)
    first = goal_of(client.take_cells(2, [0, 1], 10_002.0 - HOUR))
    assert first.stamp > stop.stamp
    second = goal_of(reach(client, first, 10_003.0 - HOUR))
    assert second.stamp > first.stamp


def test_after_a_clock_step_back_waits_begin_anew(client: MoveClient) -> None:
    """Without this a lost goal is sent again, and a silent robot counts as quiet, after an hour."""
    goal = goal_of(client.take_cells(1, [0, 1], 10_000.0))
    now = 10_000.5 - HOUR
    assert client.take_goal_states({}, now) == []
    assert client.take_goal_states({}, now + REPEAT_AFTER) == [goal]
    client.cancel(now + 1.5)
    client.take_goal_states({}, now + 1.6)
    now -= HOUR
    client.take_goal_states({}, now)
    client.take_goal_states({}, now + QUIET_TIME / 2)
    assert state_of(client) is ClientState.CANCELLING
    client.take_goal_states({}, now + QUIET_TIME)
    assert state_of(client) is ClientState.IDLE


def test_goals_of_a_clock_that_is_ahead_are_stopped() -> None:
    """A goal from before a restart on another machine, or of a person's computer."""
    client = MoveClient(GridMap(), "Robot1", 0.0)
    client.tick(0.0)
    ahead = 1_700_000_000.123456789
    client.take_goal_states({"rviz-1": GoalState.ACTIVE}, 0.5, ahead)
    (stop,) = client.tick(REPEAT_AFTER)
    assert isinstance(stop, SendStop)
    assert stop.stamp > ahead
    client.take_goal_states({"rviz-1": GoalState.PREEMPTED}, 2.0, ahead)
    client.take_goal_states({"rviz-1": GoalState.PREEMPTED}, 2.0 + QUIET_TIME, ahead)
    assert goal_of(client.take_cells(1, [0, 1], 4.0)).stamp > stop.stamp


def test_a_goal_at_the_end_of_time_breaks_no_message(client: MoveClient) -> None:
    client.take_goal_states({"rviz-1": GoalState.SUCCEEDED}, 10.0, 2.0**32 - 1)
    goal = goal_of(client.take_cells(1, [0, 1], 11.0))
    assert Time.from_sec(goal.stamp)


def test_a_robot_that_gives_up_is_reported_and_can_be_sent_again(client: MoveClient) -> None:
    goal = goal_of(client.take_cells(1, [0, 1], 10.0))
    client.take_result(goal.id, GoalState.ABORTED, 11.0)
    assert client.report == ClientReport(1, ClientState.FAILED, (), None, None)
    assert cells_sent(client.take_cells(2, [0, 8], 12.0)) == [0]


@pytest.mark.parametrize("cells", [[0, 2], [0, 64], [-1], [7, 8]])
def test_cell_list_that_is_not_a_path_is_refused(client: MoveClient, cells: list[int]) -> None:
    before = client.report
    with pytest.raises(ValueError, match="not a path"):
        client.take_cells(1, cells, 10.0)
    assert client.report == before


def test_the_number_of_a_list_travels_as_a_label() -> None:
    fields = numbered_array([3, 4], 17)
    assert fields["data"] == [3, 4]
    assert revision_of([entry["label"] for entry in fields["layout"]["dim"]]) == 17
    assert revision_of([]) is None
    assert revision_of(["cells"]) is None
    assert revision_of(["revision=x"]) is None
