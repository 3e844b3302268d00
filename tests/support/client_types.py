"""Types and messages of the client's tests."""

from __future__ import annotations

import struct

STRING = "std_msgs/String"
ECHO = "Test/StringEcho"
ROBOT = "testUser/testRobot"


def ros_string(text: str) -> bytes:
    data = text.encode()
    return struct.pack("<I", len(data)) + data
