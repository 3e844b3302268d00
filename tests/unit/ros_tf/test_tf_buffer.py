"""The buffer of transforms: answers, and reasons where there is none."""

from __future__ import annotations

import math
from graphlib import CycleError, TopologicalSorter
from itertools import pairwise

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from rce.ros.tf import (
    BadTransformError,
    Buffer,
    ConnectivityError,
    ExtrapolationError,
    FrameLoopError,
    Quaternion,
    StampedTransform,
    Transform,
    UnknownFrameError,
    Vector,
    resolve,
)
from rce.ros.tf.edges import Sample, TimedEdge
from rce.ros.types import Time


def at(seconds: float) -> Time:
    return Time.from_sec(seconds)


def edge(parent: str, child: str, seconds: float = 0.0, x: float = 0.0, yaw: float = 0.0) -> StampedTransform:
    return StampedTransform(parent, child, Transform.make(x=x, yaw=yaw), at(seconds))


def robot() -> Buffer:
    """A map with a robot that drives 1 m/s from 10 s to 12 s, with a laser on it."""
    buffer = Buffer()
    buffer.insert(edge("map", "odom", x=100), static=True)
    for second in (10, 11, 12):
        buffer.insert(edge("odom", "base", second, x=second))
    buffer.insert(edge("base", "laser", x=0.5), static=True)
    return buffer


def x_of(stamped: StampedTransform) -> float:
    return stamped.transform.translation.x


def test_the_latest() -> None:
    answer = robot().lookup("map", "laser")
    assert (answer.parent, answer.child, answer.stamp) == ("map", "laser", at(12))
    assert x_of(answer) == pytest.approx(112.5)
    assert x_of(robot().lookup("laser", "map", Time())) == pytest.approx(-112.5)


def test_a_time_between() -> None:
    answer = robot().lookup("map", "laser", at(10.25))
    assert answer.stamp == at(10.25)
    assert x_of(answer) == pytest.approx(110.75)


def test_a_frame_in_itself() -> None:
    answer = robot().lookup("base", "/base")
    assert (answer.transform, answer.stamp) == (Transform(), at(12))
    assert robot().lookup("map", "map").stamp == Time()
    assert robot().lookup("map", "map", at(5)).stamp == at(5)


def test_static_edges_alone_hold_for_ever() -> None:
    assert robot().lookup("base", "laser").stamp == Time()
    assert robot().lookup("base", "laser", at(99)).stamp == at(99)


def test_the_latest_common_time_is_that_of_the_slowest_edge() -> None:
    buffer = robot()
    buffer.insert(edge("base", "arm", 11.5, x=1))
    buffer.insert(edge("base", "arm", 10.5, x=0))
    assert buffer.latest_common_time("map", "arm") == at(11.5)
    assert x_of(buffer.lookup("map", "arm")) == pytest.approx(112.5)
    assert buffer.latest_common_time("laser", "arm") == at(11.5)


def test_siblings_need_nothing_above_their_parent() -> None:
    buffer = robot()
    buffer.insert(edge("base", "arm", 20, x=1))
    buffer.insert(edge("base", "arm", 30, x=2))
    assert x_of(buffer.lookup("laser", "arm", at(25))) == pytest.approx(1.0)


def test_what_was_seen_then_is_there_now() -> None:
    answer = robot().lookup_full("laser", at(12), "laser", at(10), "map")
    assert x_of(answer) == pytest.approx(-2)
    assert answer.stamp == at(12)


def test_an_unknown_frame_names_similar_ones() -> None:
    with pytest.raises(UnknownFrameError, match="no frame 'base_link'; similar ones are base") as caught:
        robot().lookup("map", "base_link")
    assert caught.value.frame == "base_link"
    with pytest.raises(UnknownFrameError, match=r"^there is no frame 'x'$"):
        robot().lookup("map", "x")


def test_two_trees_are_named() -> None:
    buffer = robot()
    buffer.insert(edge("other_map", "other_base", 11))
    with pytest.raises(ConnectivityError) as caught:
        buffer.lookup("laser", "other_base")
    error = caught.value
    assert (error.target, error.target_root) == ("laser", "map")
    assert (error.source, error.source_root) == ("other_base", "other_map")
    assert not buffer.can_transform("laser", "other_base")
    with pytest.raises(ConnectivityError):
        buffer.lookup("laser", "other_base", at(5))


@pytest.mark.parametrize(
    ("seconds", "text", "is_future"),
    [
        (13.5, r"13\.500000000 is 1\.500 s after the last transform from 'base' to 'odom'", True),
        (8.0, r"8\.000000000 is 2\.000 s before the first .* \(known from 10\.0+ to 12\.0+\)", False),
    ],
)
def test_times_outside_the_cache(seconds: float, text: str, is_future: bool) -> None:
    with pytest.raises(ExtrapolationError, match=text) as caught:
        robot().lookup("map", "laser", at(seconds))
    assert caught.value.is_future is is_future


def test_a_circle_is_no_tree() -> None:
    buffer = Buffer()
    for parent, child in (("a", "b"), ("b", "c"), ("c", "a"), ("x", "y")):
        buffer.insert(edge(parent, child, 1))
    with pytest.raises(FrameLoopError, match="b > a > c > b"):
        buffer.lookup("y", "b")
    assert buffer.describe() == "x\n  y (1.000 to 1.000)"


def test_a_frame_may_get_another_parent() -> None:
    buffer = Buffer()
    buffer.insert(edge("table", "cup", 1, x=1))
    buffer.insert(edge("hand", "cup", 3, x=5))
    buffer.insert(edge("room", "table"), static=True)
    buffer.insert(edge("room", "hand"), static=True)
    assert x_of(buffer.lookup("room", "cup", at(2))) == 1
    assert x_of(buffer.lookup("room", "cup", at(3))) == 5
    assert buffer.parents["cup"] == "hand"


@pytest.mark.parametrize(
    "bad",
    [
        edge("", "a"),
        edge("a", ""),
        edge("a", "a"),
        StampedTransform("a", "b", Transform(Vector(math.nan, 0, 0))),
        StampedTransform("a", "b", Transform(Vector(), Quaternion(0, 0, 0, 0))),
        StampedTransform("a", "b", Transform(Vector(), Quaternion(0, 0, 0, 1.1))),
    ],
)
def test_what_is_no_edge_is_refused(bad: StampedTransform) -> None:
    buffer = Buffer()
    with pytest.raises(BadTransformError):
        buffer.insert(bad)
    assert buffer.frames == ()


def test_old_and_repeated_transforms_change_nothing() -> None:
    buffer = robot()
    assert not buffer.insert(edge("odom", "base", 11, x=-1))
    assert not buffer.insert(edge("odom", "base", 1.9, x=-1))
    assert buffer.insert(edge("odom", "base", 2.0, x=-1))
    assert x_of(buffer.lookup("odom", "base", at(11))) == 11


def test_a_new_time_keeps_what_holds_for_ever() -> None:
    buffer = robot()
    buffer.clear()
    assert set(buffer.frames) == {"map", "odom", "base", "laser"}
    with pytest.raises(ConnectivityError):
        buffer.lookup("map", "laser")
    buffer.insert(edge("odom", "base", 1, x=1))
    assert x_of(buffer.lookup("map", "laser")) == pytest.approx(101.5)


def test_the_tree_as_text() -> None:
    assert robot().describe() == "map\n  odom (static)\n    base (10.000 to 12.000)\n      laser (static)"


@pytest.mark.parametrize(
    ("prefix", "frame", "full"),
    [
        ("", "base", "base"),
        ("", "/base", "base"),
        ("robot1", "base", "robot1/base"),
        ("/robot1", "base", "robot1/base"),
        ("/a/b/", "base", "a/b/base"),
        ("robot1", "/map", "map"),
    ],
)
def test_prefixes(prefix: str, frame: str, full: str) -> None:
    assert resolve(prefix, frame) == full


@given(st.lists(st.integers(0, 100), min_size=1))
def test_an_edge_keeps_order_and_length(times: list[int]) -> None:
    timed = TimedEdge(30)
    taken: set[int] = set()
    for time in times:
        newest = max(taken, default=0)
        is_new = timed.insert(Sample(time, "p", Transform.make(x=time)))
        assert is_new == (time not in taken and time >= newest - 30)
        taken.add(time)
        taken = {t for t in taken if t >= max(taken) - 30}
        assert [sample.time for sample in timed.samples] == sorted(taken)
    for older, newer in pairwise(timed.samples):
        between = (older.time + newer.time) // 2
        assert timed.at("c", between).transform.translation.x == pytest.approx(between)


names = st.sampled_from("abcdefgh")


def goes_in_a_circle(edges: list[tuple[str, str, int]]) -> bool:
    """Whether some frame is its own ancestor, by parents that it has at some time."""
    parents: dict[str, set[str]] = {}
    for parent, child, _ in edges:
        if parent != child:
            parents.setdefault(child, set()).add(parent)
    try:
        TopologicalSorter(parents).prepare()
    except CycleError:
        return True
    return False


@example([("a", "b", 1), ("b", "a", 1)], "a", "b", 0)
@given(st.lists(st.tuples(names, names, st.integers(1, 20))), names, names, st.integers(0, 20))
def test_every_question_has_an_answer_or_a_reason(
    edges: list[tuple[str, str, int]], target: str, source: str, time: int
) -> None:
    buffer = Buffer()
    for parent, child, second in edges:
        if parent != child:
            buffer.insert(edge(parent, child, second, x=second, yaw=second))
    try:
        there = buffer.lookup(target, source, at(time)).transform
    except (UnknownFrameError, ConnectivityError, ExtrapolationError, FrameLoopError):
        assert not buffer.can_transform(target, source, at(time))
    else:
        if not goes_in_a_circle(edges):
            back = buffer.lookup(source, target, at(time)).transform
            assert (there @ back).translation == pytest.approx((0, 0, 0), abs=1e-9)
