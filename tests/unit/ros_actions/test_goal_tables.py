"""The two tables of states."""

from __future__ import annotations

import json
import subprocess
from itertools import pairwise

import pytest

from rce.ros.actions.states import CLIENT_TRANSITIONS, GOAL_LIFE, CommState, GoalState


def test_every_goal_comes_to_an_end() -> None:
    following = {state: set(row.values()) for state, row in GOAL_LIFE.table.items()}
    for state in GoalState:
        assert state.is_over == (not following[state])
    reached = {GoalState.PENDING}
    while more := {after for state in reached for after in following[state]} - reached:
        reached |= more
    assert reached == set(GoalState) - {GoalState.LOST}


def test_clients_can_follow_every_way_of_a_server() -> None:
    """From what a server reports, the client's state is the one of a client that saw each step."""
    after = {
        GoalState.PENDING: CommState.PENDING,
        GoalState.ACTIVE: CommState.ACTIVE,
        GoalState.RECALLING: CommState.RECALLING,
        GoalState.PREEMPTING: CommState.PREEMPTING,
    }
    for state, row in GOAL_LIFE.table.items():
        for reported in row.values():
            passed = CLIENT_TRANSITIONS[after[state]][reported]
            assert passed[-1] == after.get(reported, CommState.WAITING_FOR_RESULT)


def test_every_path_is_possible_step_by_step() -> None:
    paths = [(comm, path) for comm, row in CLIENT_TRANSITIONS.items() for path in row.values()]
    steps = {(comm, path[0]) for comm, path in paths if len(path) == 1}
    for comm, path in paths:
        assert steps.issuperset(pairwise(path)), (comm, path)


@pytest.mark.slow
@pytest.mark.needs("actionlib")
def test_the_client_table_is_that_of_rospy() -> None:
    program = (
        "import json\n"
        "from actionlib.action_client import _transitions as t\n"
        "print(json.dumps([[comm, status, n] for comm in t for status, n in t[comm].items()]))\n"
    )
    done = subprocess.run(
        ["/usr/bin/python3", "-c", program], capture_output=True, text=True, check=True, timeout=30
    )
    theirs = {}
    for comm, status, following in json.loads(done.stdout):
        if following != -2:  # an invalid transition
            states = following if isinstance(following, list) else [following]
            theirs[comm, status] = [] if following == -1 else states
    ours = {
        (comm.value, state.value): [passed.value for passed in path]
        for comm, row in CLIENT_TRANSITIONS.items()
        for state, path in row.items()
    }
    assert ours == theirs
