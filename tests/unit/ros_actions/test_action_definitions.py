"""Message types of .action files: the texts and checksums that ROS makes of them."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import pytest

from rce.ros.packages import PackageIndex
from rce.ros.types import BadDefinitionError, TypeRegistry, UnknownTypeError
from rce.ros.types.action import action_names, parse_action

COUNT = """# how far
int32 target   # a number
Point where
---
bool ok
---
int32 n
geometry_msgs/Pose[] path
"""
SUFFIXES = ("Action", "ActionGoal", "ActionResult", "ActionFeedback", "Goal", "Result", "Feedback")


def package(folder: Path, **actions: str) -> TypeRegistry:
    for name, text in actions.items():
        file = folder / "mine" / "action" / f"{name}.action"
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
    (folder / "mine" / "package.yaml").write_text("description: actions\n")
    (folder / "mine" / "msg").mkdir(exist_ok=True)
    (folder / "mine" / "msg" / "Point.msg").write_text("int8 x\n")
    return TypeRegistry(PackageIndex([folder]))


def test_an_action_of_a_package(tmp_path: Path) -> None:
    types = package(tmp_path, Count=COUNT)
    assert [field.declared for field in types.message("mine/CountGoal").fields] == ["int32", "mine/Point"]
    assert [field.declared for field in types.message("mine/CountFeedback").fields] == [
        "int32",
        "geometry_msgs/Pose[]",
    ]
    assert [(f.declared, f.name) for f in types.message("mine/CountAction").fields] == [
        ("mine/CountActionGoal", "action_goal"),
        ("mine/CountActionResult", "action_result"),
        ("mine/CountActionFeedback", "action_feedback"),
    ]
    assert [f.declared for f in types.message("mine/CountActionResult").fields] == [
        "std_msgs/Header",
        "actionlib_msgs/GoalStatus",
        "mine/CountResult",
    ]
    kind = types.message("mine/CountActionGoal")
    message = kind.new(goal={"target": 3, "where": {"x": 1}}, goal_id={"id": "a"})
    assert kind.deserialize(kind.serialize(message)).goal.where.x == 1


@pytest.mark.parametrize(
    ("name", "md5sum"),
    [
        ("actionlib_tutorials/FibonacciAction", "f59df5767bf7634684781c92598b2406"),
        ("actionlib_tutorials/AveragingAction", "628678f2b4fa6a5951746a4a2d39e716"),
        ("actionlib/TestAction", "991e87a72802262dfbe5d1b3cf6efc9a"),
    ],
)
def test_known_checksums_of_builtin_actions(name: str, md5sum: str) -> None:
    assert TypeRegistry(PackageIndex([])).message(name).md5sum == md5sum


def test_mistakes_are_found_where_they_are(tmp_path: Path) -> None:
    types = package(tmp_path, Bad="int32 a\n---\nint32 b\n---\n# fine\nnonsense\n", Two="int32 a\n---\n")
    with pytest.raises(BadDefinitionError, match=r"Bad\.action:6"):
        types.message("mine/BadFeedback")
    with pytest.raises(BadDefinitionError, match="two '---' lines, this text has 1"):
        types.message("mine/TwoGoal")
    with pytest.raises(UnknownTypeError):
        types.message("mine/NoneGoal")


def test_an_action_may_have_a_name_that_ends_like_a_part(tmp_path: Path) -> None:
    types = package(tmp_path, ScoreGoal="int8 a\n---\n---\n", Call="int16 b\n---\n---\n")
    assert types.message("mine/ScoreGoalGoal").fields[0].name == "a"
    assert types.message("mine/ScoreGoalAction").fields[0].type == "mine/ScoreGoalActionGoal"
    assert types.message("mine/CallActionGoal").fields[2].type == "mine/CallGoal"
    assert list(action_names("XActionGoal")) == [("X", "ActionGoal"), ("XAction", "Goal")]
    assert list(action_names("Goal")) == []


def test_there_are_seven_parts() -> None:
    assert set(parse_action("Count", COUNT)) == set(SUFFIXES)


@pytest.mark.slow
@pytest.mark.needs("actionlib")
def test_texts_and_checksums_are_those_of_installed_classes(tmp_path: Path) -> None:
    """The package's .action files alone give what ROS generated from them."""
    program = (
        "import json, actionlib.msg\n"
        "classes = [c for c in vars(actionlib.msg).values() if hasattr(c, '_md5sum')]\n"
        "print(json.dumps({c._type: [c._md5sum, c._full_text] for c in classes}))\n"
    )
    done = subprocess.run(
        ["/usr/bin/python3", "-c", program], capture_output=True, text=True, check=True, timeout=30
    )
    classes: dict[str, list[str]] = json.loads(done.stdout)
    (tmp_path / "actionlib" / "action").mkdir(parents=True)
    (tmp_path / "actionlib" / "package.yaml").write_text("description: a copy\n")
    for file in Path("/usr/share/actionlib/action").glob("*.action"):
        (tmp_path / "actionlib" / "action" / file.name).write_bytes(file.read_bytes())
    types, builtin = TypeRegistry(PackageIndex([tmp_path])), TypeRegistry(PackageIndex([]))
    assert len(classes) == 21
    for name, (md5sum, full_text) in classes.items():
        assert types.message(name).md5sum == builtin.message(name).md5sum == md5sum, name
        assert types.message(name).own_text.split() == full_text.split("=" * 80)[0].split(), name
