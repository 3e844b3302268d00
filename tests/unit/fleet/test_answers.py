"""What move clients say on the topic of their lists."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rce.ros.types import TypeRegistry
from rce_fleet.coordination.answers import (
    Answer,
    answer_array,
    is_answer,
    numbered_array,
    read_answer,
    revision_of,
)
from rce_fleet.coordination.move_client import ClientReport, ClientState
from rce_fleet.coordination.robot_signs import RobotSign
from rce_fleet.nodes.grid_parameters import make_grid

CELLS = st.lists(st.integers(0, 2**31 - 1), max_size=5).map(tuple)
PLACES = st.one_of(st.none(), st.integers(0, 2**31 - 1))
REPORTS = st.builds(
    ClientReport, st.integers(0, 2**40), st.sampled_from(ClientState), CELLS, reached=PLACES, target=PLACES
)
ARRAY = TypeRegistry().message("std_msgs/Int32MultiArray")


NUMBERS = st.floats(-1e9, 1e9)
SIGNS = st.builds(RobotSign, st.none() | st.floats(0, 1e9), st.none() | st.tuples(NUMBERS, NUMBERS, NUMBERS))


@given(report=REPORTS, blocked=CELLS, sign=SIGNS)
def test_encoded_answer_is_decoded(report: ClientReport, blocked: tuple[int, ...], sign: RobotSign) -> None:
    message = ARRAY.deserialize(ARRAY.serialize(answer_array(Answer(report, blocked, (), sign))))
    labels = [dimension.label for dimension in message.layout.dim]
    assert is_answer(labels)
    assert revision_of(labels) is None
    read = read_answer(labels, [dimension.size for dimension in message.layout.dim], message.data)
    assert read == Answer(report, blocked, (), sign)


def test_cell_lists_are_not_answers() -> None:
    assert not is_answer([dimension["label"] for dimension in numbered_array([1], 3)["layout"]["dim"]])
    assert not is_answer([])


@pytest.mark.parametrize(
    ("labels", "sizes", "data"),
    [
        (["revision=3"], [1], [5]),
        (["answer=3 driving", "", ""], [1, 2], [5, 1, 1]),
        (["answer=3 driving", "", ""], [1, 2, 0], [5, 1]),
        (["answer=3 driving", "", ""], [1, 3, 0], [5, 1, 1, 1]),
        (["answer=x driving", "", ""], [1, 2, 0], [5, 1, 1]),
        (["answer=9007199254740993 driving", "", ""], [1, 2, 0], [5, 1, 1]),
        (["answer=-1 driving", "", ""], [1, 2, 0], [5, 1, 1]),
        (["answer=3 flying", "", ""], [1, 2, 0], [5, 1, 1]),
        (["answer=3 driving", "robot_age=long", ""], [1, 2, 0], [5, 1, 1]),
        (["answer=3 driving", "pose=1,2", ""], [1, 2, 0], [5, 1, 1]),
    ],
)
def test_answer_of_another_form_is_refused(labels: list[str], sizes: list[int], data: list[int]) -> None:
    with pytest.raises(ValueError, match=r"answer|invalid literal|must be|convert|unpack"):
        read_answer(labels, sizes, data)


def test_a_map_of_parameters() -> None:
    grid = make_grid({"rows": 3, "columns": 4, "cell_size": 0.5, "origin_x": 1, "walls": [5]})
    assert (grid.rows, grid.columns, grid.cell_size, grid.origin) == (3, 4, 0.5, (1.0, 0.0))
    assert grid.blocked == {5}
