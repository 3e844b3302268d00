"""Values of ROS parameters in dataclasses: types, ranges, unknown names, namespaces."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum
from typing import Any, Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rce_fleet.nodes.parameter_values import read_values, searched_names


class Model(Enum):
    DIFF = "diff"
    OMNI = "omni"


@dataclass(frozen=True)
class Costmap:
    resolution: float = field(default=0.05, metadata={"above": 0.0})
    footprint: str | tuple[tuple[float, float], ...] = field(default=(), metadata={"search": True})
    global_frame: str = "map"


@dataclass(frozen=True)
class Settings:
    min_particles: int = field(default=100, metadata={"minimum": 1})
    max_particles: int = field(default=5000, metadata={"minimum": 1})
    odom_alpha1: float = field(default=0.2, metadata={"minimum": 0.0, "maximum": 10.0})
    odom_model_type: Model = Model.DIFF
    laser_model: Literal["beam", "likelihood_field"] = field(
        default="likelihood_field", metadata={"name": "laser_model_type"}
    )
    use_map_topic: bool = False
    base_frame_id: str = "base_link"
    waypoints: tuple[float, ...] = ()
    pose: tuple[float, float, float] = (0.0, 0.0, 0.0)
    timeout: float | None = None
    local_costmap: Costmap = field(default_factory=lambda: Costmap(global_frame="odom"))

    def __post_init__(self) -> None:
        if self.min_particles > self.max_particles:
            raise ValueError(f"min_particles {self.min_particles} exceeds {self.max_particles}")


def read(**values: Any) -> tuple[Settings, list[str]]:
    made, problems = read_values(Settings, values)
    return made, [problem.text for problem in problems]


def test_no_values_give_the_defaults() -> None:
    assert read() == (Settings(), [])


@pytest.mark.parametrize(
    ("name", "value", "read_as"),
    [
        ("odom_alpha1", 1, 1.0),
        ("odom_alpha1", "1e-3", 0.001),
        ("min_particles", 7.0, 7),
        ("odom_model_type", "omni", Model.OMNI),
        ("laser_model_type", "beam", "beam"),
        ("use_map_topic", True, True),
        ("waypoints", [1, 2.5], (1.0, 2.5)),
        ("pose", [1, 2, 3], (1.0, 2.0, 3.0)),
        ("timeout", 3, 3.0),
    ],
)
def test_a_fitting_value_is_taken(name: str, value: object, read_as: object) -> None:
    made, problems = read(**{name: value})
    assert problems == []
    found = getattr(made, {"laser_model_type": "laser_model"}.get(name, name))
    assert (found, type(found)) == (read_as, type(read_as))


@pytest.mark.parametrize(
    ("name", "value", "text"),
    [
        ("odom_alpha1", "much", "parameter ~odom_alpha1 is 'much', must be a number; 0.2 is used"),
        ("odom_alpha1", True, "parameter ~odom_alpha1 is True, must be a number; 0.2 is used"),
        ("odom_alpha1", float("nan"), "parameter ~odom_alpha1 is nan, must be a number; 0.2 is used"),
        ("odom_alpha1", -1, "parameter ~odom_alpha1 is -1, must be at least 0.0; 0.2 is used"),
        ("odom_alpha1", 11, "parameter ~odom_alpha1 is 11, must be at most 10.0; 0.2 is used"),
        ("min_particles", 7.5, "parameter ~min_particles is 7.5, must be an integer; 100 is used"),
        ("use_map_topic", 1, "parameter ~use_map_topic is 1, must be true or false; False is used"),
        ("base_frame_id", 1, "parameter ~base_frame_id is 1, must be text; 'base_link' is used"),
        ("odom_model_type", "x", "must be one of diff, omni"),
        ("laser_model_type", "x", "must be one of beam, likelihood_field"),
        ("waypoints", 3, "must be a list"),
        ("waypoints", [1, "x"], "must be a list in which each entry is a number"),
        ("pose", [1, 2], "must be a list of 3 entries"),
        ("local_costmap", 3, "~local_costmap is 3, must be a namespace; the defaults are used"),
    ],
)
def test_an_unfit_value_leaves_the_default(name: str, value: object, text: str) -> None:
    made, problems = read(**{name: value})
    assert made == Settings()
    assert len(problems) == 1
    assert text in problems[0]


def test_a_value_is_left_out_if_it_contradicts_another() -> None:
    made, problems = read(min_particles=6000, odom_alpha1=0.5)
    assert made == Settings(odom_alpha1=0.5)
    assert problems == ["~min_particles: min_particles 6000 exceeds 5000; 100 is used"]


def test_an_unknown_parameter_names_the_nearest() -> None:
    made, problems = read(laser_model_typ="beam", odom_alpha=3)
    assert made == Settings()
    assert problems == [
        "unknown parameter ~laser_model_typ; did you mean ~laser_model_type?",
        "unknown parameter ~odom_alpha; did you mean ~odom_alpha1?",
    ]


def test_namespaces_of_others_are_left_alone() -> None:
    assert read(DWAPlannerROS={"anything": 1}) == (Settings(), [])


def test_a_misspelt_namespace_is_reported() -> None:
    assert read(local_costmp={"resolution": 1.0}) == (
        Settings(),
        ["unknown namespace ~local_costmp; did you mean ~local_costmap?"],
    )


def test_a_parameter_without_use_here_is_reported() -> None:
    _, problems = read_values(Settings, {"gui_publish_rate": 10}, unused=["gui_publish_rate"])
    assert [(one.text, one.is_unknown) for one in problems] == [
        ("parameter ~gui_publish_rate has no effect: this node does not use it", True)
    ]


def test_a_namespace_keeps_its_own_defaults() -> None:
    made, problems = read(local_costmap={"resolution": 0.1, "globl_frame": "x"})
    assert made.local_costmap == Costmap(resolution=0.1, global_frame="odom")
    assert problems == [
        "unknown parameter ~local_costmap/globl_frame; did you mean ~local_costmap/global_frame?"
    ]


def test_a_searched_parameter_is_found_further_out() -> None:
    square = [[0, 0], [0, 1], [1, 1]]
    assert searched_names(Settings) == {"footprint"}
    made, problems = read(footprint=square)
    assert (made.local_costmap.footprint, problems) == (((0.0, 0.0), (0.0, 1.0), (1.0, 1.0)), [])
    made, _ = read_values(Settings, {}, outer={"footprint": "[[0, 0]]"})
    assert made.local_costmap.footprint == "[[0, 0]]"
    made, _ = read_values(Settings, {"local_costmap": {"footprint": "near"}}, outer={"footprint": "far"})
    assert made.local_costmap.footprint == "near"


def test_a_declaration_without_a_default_is_refused() -> None:
    @dataclass(frozen=True)
    class Bad:
        rate: float

    with pytest.raises(TypeError, match=r"Bad\.rate: a parameter must have a default"):
        read_values(Bad, {})


VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=5,
)
NAMES = st.sampled_from([*Settings.__dataclass_fields__, "laser_model_type", "local", ""])


@given(values=st.dictionaries(NAMES, VALUES, max_size=6))
def test_any_values_give_settings_that_are_allowed(values: dict[str, Any]) -> None:
    made, _ = read_values(Settings, values)
    assert 1 <= made.min_particles <= made.max_particles
    assert 0.0 <= made.odom_alpha1 <= 10.0
    assert made.local_costmap.resolution > 0.0
