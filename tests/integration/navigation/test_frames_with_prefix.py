"""Robots that share a core have prefixed frames: names with and without the prefix mean the same."""

from __future__ import annotations

import pytest

from rce.ros.core import Core
from rce.ros.node import Node
from rce.ros.tf import TransformListener
from rce_fleet.nodes.robot_place import full_name, named_in_message


@pytest.mark.parametrize(
    ("prefix", "frame", "full"),
    [
        ("Robot1", "odom", "/Robot1/odom"),
        ("Robot1", "Robot1/odom", "/Robot1/odom"),
        ("Robot1", "/map", "/map"),
        ("", "odom", "/odom"),
        ("", "Robot1/odom", "/Robot1/odom"),
    ],
)
async def test_a_frame_of_a_parameter_gets_the_prefix_once(prefix: str, frame: str, full: str) -> None:
    async with (
        Core(port=0) as core,
        Node("judge", argv=[], master_uri=core.uri) as node,
        TransformListener(node, prefix=prefix) as transforms,
    ):
        assert full_name(transforms, frame) == full
        assert transforms.resolve(full) == full[1:]


def test_a_frame_of_a_message_is_full() -> None:
    assert (
        named_in_message("Robot1/base_scan") == named_in_message("/Robot1/base_scan") == "/Robot1/base_scan"
    )
