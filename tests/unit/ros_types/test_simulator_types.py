"""Types of simulators and of TurtleBots have the checksums that their packages publish."""

from __future__ import annotations

import pytest

from rce.ros.packages import PackageIndex
from rce.ros.types import TypeRegistry

MESSAGES = {
    "gazebo_msgs/ModelState": "9330fd35f2fcd82d457e54bd54e10593",
    "gazebo_msgs/ModelStates": "48c080191eb15c41858319b4d8a609c2",
    "kobuki_msgs/BumperEvent": "ffe360cd50f14f9251d9844083e72ac5",
}
PARTS = {
    "gazebo_msgs/GetModelState": ("", "ccd51739bb00f0141629e87b792e92b9"),
    "gazebo_msgs/GetWorldProperties": ("", "36bb0f2eccf4d8be971410c22818ba3f"),
    "gazebo_msgs/SpawnModel": ("6d0eba5753761cd57e6263a056b79930", ""),
}
"""Checksums of requests and responses; empty where none is published."""


@pytest.mark.parametrize(("name", "md5sum"), MESSAGES.items())
def test_message_checksums_of_simulators(name: str, md5sum: str) -> None:
    assert TypeRegistry(PackageIndex([])).message(name).md5sum == md5sum


@pytest.mark.parametrize("name", PARTS)
def test_checksums_of_requests_and_responses(name: str) -> None:
    known = TypeRegistry(PackageIndex([])).service(name)
    for part, md5sum in zip((known.request, known.response), PARTS[name], strict=True):
        assert not md5sum or part.md5sum == md5sum


def test_checksum_of_a_whole_service() -> None:
    known = TypeRegistry(PackageIndex([])).service("gazebo_msgs/SetModelState")
    assert known.md5sum == "5b3ab0281d4f5445def017e3a2e4a07b"
