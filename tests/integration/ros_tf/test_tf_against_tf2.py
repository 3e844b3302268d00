"""The buffer gives the answers that ROS's own tf2 gives, on random trees."""

from __future__ import annotations

import asyncio
import json
import random
from typing import Any

import pytest
from support.processes import finish

from rce.ros.tf import Buffer, Quaternion, StampedTransform, Transform, TransformError, Vector
from rce.ros.types import Time

pytestmark = pytest.mark.needs("tf2")

TREES = 60
QUESTIONS = 40

ORACLE = """
import json, sys
import rospy, tf2_py
from geometry_msgs.msg import TransformStamped

def transform(parent, child, stamp, values):
    message = TransformStamped()
    message.header.frame_id, message.child_frame_id = parent, child
    message.header.stamp = rospy.Time(*stamp)
    moved, turned = message.transform.translation, message.transform.rotation
    moved.x, moved.y, moved.z, turned.x, turned.y, turned.z, turned.w = values
    return message

def answer(buffer, question):
    try:
        if question["fixed"]:
            found = buffer.lookup_transform_full_core(
                question["target"], rospy.Time(*question["time"]), question["source"],
                rospy.Time(*question["source_time"]), question["fixed"])
        else:
            found = buffer.lookup_transform_core(
                question["target"], question["source"], rospy.Time(*question["time"]))
    except tf2_py.TransformException as error:
        return type(error).__name__
    moved, turned = found.transform.translation, found.transform.rotation
    return [[found.header.stamp.secs, found.header.stamp.nsecs],
            [moved.x, moved.y, moved.z, turned.x, turned.y, turned.z, turned.w]]

answers = []
for tree in json.load(sys.stdin):
    buffer = tf2_py.BufferCore(rospy.Duration(10))
    for edge in tree["edges"]:
        take = buffer.set_transform_static if edge["static"] else buffer.set_transform
        take(transform(edge["parent"], edge["child"], edge["stamp"], edge["values"]), "test")
    answers.append([answer(buffer, question) for question in tree["questions"]])
json.dump(answers, sys.stdout)
"""


def random_values(choice: random.Random) -> list[float]:
    rotation = Quaternion.from_euler(*(choice.uniform(-3.2, 3.2) for _ in range(3)))
    return [*(choice.uniform(-10, 10) for _ in range(3)), *rotation]


def random_time(choice: random.Random) -> list[int]:
    return [choice.randint(1000, 1012), choice.choice([0, 250_000_000, choice.randrange(10**9)])]


def random_tree(choice: random.Random) -> dict[str, Any]:
    """Return edges in the order of their arrival, some of them late, and questions; often not one tree."""
    frames = [f"f{index}" for index in range(choice.randint(2, 9))]
    edges: list[dict[str, Any]] = []
    for index, child in enumerate(frames[1:], 1):
        if choice.random() < 0.15:
            continue
        static = choice.random() < 0.3
        parents = [choice.choice(frames[:index]) for _ in range(choice.choice([1, 1, 1, 2]))]
        edges += [
            {
                "parent": choice.choice(parents),
                "child": child,
                "stamp": random_time(choice),
                "values": random_values(choice),
                "static": static,
            }
            for _ in range(1 if static else choice.randint(1, 12))
        ]
    choice.shuffle(edges)
    # tf2 answers questions of frames that it does not know, if they are the same, with a transform of zeros.
    frames = sorted({edge[end] for edge in edges for end in ("parent", "child")})
    questions = [
        {
            "target": choice.choice(frames),
            "source": choice.choice(frames),
            "time": choice.choice([[0, 0], random_time(choice)]),
            "source_time": choice.choice([[0, 0], random_time(choice)]),
            "fixed": choice.choice(["", "", choice.choice(frames)]),
        }
        for _ in range(QUESTIONS if frames else 0)
    ]
    return {"edges": edges, "questions": questions}


async def ask_tf2(trees: list[dict[str, Any]]) -> list[list[Any]]:
    process = await asyncio.create_subprocess_exec(
        "/usr/bin/python3",
        "-c",
        ORACLE,
        stdin=asyncio.subprocess.PIPE,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.DEVNULL,
        env={"PATH": "/usr/bin:/bin"},
    )
    try:
        output, _ = await asyncio.wait_for(process.communicate(json.dumps(trees).encode()), 50)
    finally:
        await finish(process)
    answers: list[list[Any]] = json.loads(output)
    return answers


def filled(tree: dict[str, Any]) -> Buffer:
    buffer = Buffer()
    for edge in tree["edges"]:
        transform = Transform(Vector(*edge["values"][:3]), Quaternion(*edge["values"][3:]))
        stamped = StampedTransform(edge["parent"], edge["child"], transform, Time(*edge["stamp"]))
        buffer.insert(stamped, static=edge["static"])
    return buffer


def our_answer(buffer: Buffer, question: dict[str, Any]) -> StampedTransform | None:
    target, source, time = question["target"], question["source"], Time(*question["time"])
    try:
        if question["fixed"]:
            source_time = Time(*question["source_time"])
            return buffer.lookup_full(target, time, source, source_time, question["fixed"])
        return buffer.lookup(target, source, time)
    except TransformError:
        return None


async def test_answers_on_random_trees_are_those_of_tf2() -> None:
    choice = random.Random(1)
    trees = [random_tree(choice) for _ in range(TREES)]
    answered = refused = 0
    for tree, expected in zip(trees, await ask_tf2(trees), strict=True):
        buffer = filled(tree)
        for question, theirs in zip(tree["questions"], expected, strict=True):
            ours = our_answer(buffer, question)
            if isinstance(theirs, str):
                assert ours is None, (theirs, question, buffer.describe())
                refused += 1
                continue
            assert ours is not None, (theirs, question, buffer.describe())
            stamp, values = theirs
            assert [ours.stamp.secs, ours.stamp.nsecs] == stamp
            assert ours.transform.translation == pytest.approx(values[:3], abs=1e-6)
            assert abs(ours.transform.rotation.dot(Quaternion(*values[3:]))) == pytest.approx(1, abs=1e-9)
            answered += 1
    assert answered > 300
    assert refused > 300
