#!/usr/bin/env python3
"""Counts, five times a second, on ``count`` (std_msgs/UInt64); its count is saved and restored on request.

The same as ``Test/counter.py``, with rospy. The classes of ``rce_msgs/SaveState`` and
``rce_msgs/RestoreState`` are written by hand, so that nothing has to be built; a catkin workspace makes them
from the ``.srv`` files.
"""

from __future__ import annotations

import contextlib
import struct
from typing import BinaryIO

import genpy
import rospy
from std_msgs.msg import UInt64

MD5SUM = "f43a8e1b362b75baa741461b46adc7e0"


class Empty(genpy.Message):  # type: ignore[misc]  # rospy has no types
    """A request or response without fields."""

    _type, _md5sum = "rce_msgs/Empty", "d41d8cd98f00b204e9800998ecf8427e"
    __slots__: tuple[str, ...] = ()
    _slot_types: tuple[str, ...] = ()

    def serialize(self, buff: BinaryIO) -> None:
        """Write nothing."""

    def deserialize(self, _data: bytes) -> Empty:
        """Read nothing."""
        return self


class State(genpy.Message):  # type: ignore[misc]  # rospy has no types
    """A request or response with one field, ``uint8[] data``."""

    _type, _md5sum = "rce_msgs/State", MD5SUM
    __slots__ = ("data",)
    _slot_types = ("uint8[]",)
    data: bytes

    def serialize(self, buff: BinaryIO) -> None:
        """Write the length, then the bytes."""
        buff.write(struct.pack("<I", len(self.data)) + self.data)

    def deserialize(self, data: bytes) -> State:
        """Read the length, then the bytes."""
        (length,) = struct.unpack_from("<I", data)
        self.data = data[4 : 4 + length]
        return self


class SaveState:
    """The service type that returns a node's state."""

    _type, _md5sum = "rce_msgs/SaveState", MD5SUM
    _request_class, _response_class = Empty, State


class RestoreState:
    """The service type that gives a node its state."""

    _type, _md5sum = "rce_msgs/RestoreState", MD5SUM
    _request_class, _response_class = State, Empty


class Counter:
    """Counts."""

    def __init__(self) -> None:
        self.count = 0
        self.counts = rospy.Publisher("count", UInt64, queue_size=1, latch=True)
        rospy.Service("save_count", SaveState, self.save)
        rospy.Service("restore_count", RestoreState, self.restore)

    def save(self, _request: Empty) -> State:
        """Answer with the count."""
        return State(str(self.count).encode())

    def restore(self, request: State) -> Empty:
        """Take over a count."""
        if not request.data.isdigit():
            raise rospy.ServiceException(f"{request.data[:40]!r} is not a count")
        self.count = int(request.data)
        rospy.loginfo("goes on from %d", self.count)
        return Empty()

    def run(self) -> None:
        """Count until the node is told to stop."""
        rate = rospy.Rate(5)
        while not rospy.is_shutdown():
            rate.sleep()
            self.count += 1
            self.counts.publish(self.count)


if __name__ == "__main__":
    rospy.init_node("counter")
    with contextlib.suppress(rospy.ROSInterruptException):
        Counter().run()
