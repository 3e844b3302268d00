"""The command line of the paper's move client: topics as arguments."""

from __future__ import annotations

import pytest

from rce.ros.node.settings import NodeSettings
from rce_fleet.nodes.move_client_pthread import name_arguments

TOPICS = ["/Robot1/goalNodesList", "/Robot1/cancelGoal", "/Robot1/amcl_pose", "/Robot1/move_base"]
NAMES = ("goalNodesList", "cancelGoal", "move_base/goal", "move_base/feedback")


def resolved(*words: str) -> tuple[str, dict[str, str]]:
    """The node's name, and what becomes of the names that a move client uses."""
    settings = NodeSettings.gather("move_client", namespace="", argv=name_arguments(words), environ={})
    resolver = settings.resolver
    return resolver.node_name, {name: resolver.resolve(name) for name in NAMES}


@pytest.mark.parametrize("words", [TOPICS, TOPICS[::-1], TOPICS[:1]])
def test_topics_of_one_namespace_in_any_order(words: list[str]) -> None:
    assert resolved(*words) == ("/Robot1/move_client", {name: f"/Robot1/{name}" for name in NAMES})


def test_topics_may_be_elsewhere() -> None:
    name, topics = resolved("/Robot1/goalNodesList", "/stop/cancelGoal", "/base1/move_base")
    assert name == "/Robot1/move_client"
    assert topics == {
        "goalNodesList": "/Robot1/goalNodesList",
        "cancelGoal": "/stop/cancelGoal",
        "move_base/goal": "/base1/move_base/goal",
        "move_base/feedback": "/base1/move_base/feedback",
    }


def test_a_given_namespace_and_parameters_are_kept() -> None:
    words = name_arguments([*TOPICS, "__ns:=/R", "_answers:=true", "__name:=mover"])
    assert {"__ns:=/R", "_answers:=true", "__name:=mover"} <= set(words)
    assert resolved(*TOPICS, "__ns:=/R")[1]["goalNodesList"] == "/Robot1/goalNodesList"


@pytest.mark.parametrize(
    ("words", "fault"),
    [
        ([], "found no goalNodesList"),
        (["/Robot1/cancelGoal"], "found no goalNodesList"),
        ([*TOPICS, "/Robot1/odom"], "found '/Robot1/odom'"),
        (["Robot1/goalNodesList"], "found 'Robot1/goalNodesList'"),
        (["/a-b/goalNodesList"], "found '/a-b/goalNodesList'"),
        ([*TOPICS, "/Robot2/cancelGoal"], "found /Robot1/cancelGoal and /Robot2/cancelGoal"),
        (["/goalNodesList"], "is not in a robot's namespace"),
        (["/a/b/goalNodesList"], "is not in a robot's namespace"),
    ],
)
def test_wrong_arguments_are_named(words: list[str], fault: str) -> None:
    with pytest.raises(ValueError, match="move_client_pthread takes topics") as caught:
        name_arguments(words)
    assert fault in str(caught.value)
