"""Frames: what a page gets of a layer. Pure.

A frame has four bytes with the length of its header (little-endian), the header in JSON, filled up with
spaces to a multiple of four bytes, and the layer's numbers (little-endian):

* scan: the ranges as float32;
* particles and plan: x, y, yaw as float32, one after the other;
* map and costmaps: the cells as bytes (255: unknown), row by row from the lowest, compressed with zlib.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from math import isfinite
from typing import Any

ALIGNMENT = 4


class LayerError(Exception):
    """A message cannot be shown; the text says what was expected and what was found."""


@dataclass(frozen=True, slots=True)
class LayerData:
    """What a message shows, in its own frame.

    Attributes:
        frame_id: The frame of the coordinates.
        stamp_ns: Time of the message, nanoseconds; 0 if it has none.
        fields: What the page needs to draw the numbers.
        numbers: The numbers, as they are sent.
        notes: What the operator should know about the message.
    """

    frame_id: str
    stamp_ns: int
    fields: dict[str, Any]
    numbers: bytes
    notes: tuple[str, ...] = field(default=())


@dataclass(frozen=True, slots=True)
class Placement:
    """Where a message's frame lies on the map.

    Attributes:
        pose: x, y (metres) and yaw (radians) of the frame in the map frame.
        note: What the operator should know about it; empty if it is exact.
        is_upside_down: Whether the frame's z points downwards, as that of a scanner that hangs.
    """

    pose: tuple[float, float, float]
    note: str = ""
    is_upside_down: bool = False


_CLOCKWISE = frozenset({"angle_min", "angle_increment"})
"""Fields of a scan that change their sign with the side from which it is seen."""
OLD_S = 5.0
"""Difference between a live message's stamp and the time from which the operator is told."""
_WALL_CLOCK_FROM_S = 1e9
"""Stamps from this one on, seconds, are times of a clock; simulations begin at 0."""


def stamp_note(stamp_ns: int, previous_ns: int, now: float) -> str:
    """Return what the operator should know about the stamp of a live message; empty if it is fine.

    Args:
        stamp_ns: The stamp, nanoseconds.
        previous_ns: The stamp of the message before, nanoseconds; 0 if there is none.
        now: The time of the station's clock, seconds.
    """
    if 0 < stamp_ns < previous_ns:
        return f"its stamp is {(previous_ns - stamp_ns) / 1e9:.1f} s before that of the message before"
    age = now - stamp_ns / 1e9
    if stamp_ns / 1e9 < _WALL_CLOCK_FROM_S or abs(age) < OLD_S:
        return ""
    return f"its stamp is {abs(age):.0f} s in the {'past' if age > 0 else 'future'}"


def encode(robot: str, layer: str, data: LayerData, placement: Placement) -> bytes:
    """Return a frame for the pages.

    Raises:
        LayerError: The placement is not finite.
    """
    if not all(map(isfinite, placement.pose)):
        raise LayerError(f"the pose of frame {data.frame_id!r} on the map is not finite: {placement.pose}")
    fields = dict(data.fields)
    if placement.is_upside_down:  # Seen from above, such a scanner turns clockwise.
        fields |= {name: -fields[name] for name in fields.keys() & _CLOCKWISE}
    header = {
        "type": "layer",
        "robot": robot,
        "layer": layer,
        "stamp": data.stamp_ns / 1e9,
        "frame": data.frame_id,
        "pose": [round(value, 4) for value in placement.pose],
        "notes": [*data.notes, *filter(None, [placement.note])],
        **fields,
    }
    text = json.dumps(header, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-(len(text) + ALIGNMENT) % ALIGNMENT)
    return len(text).to_bytes(4, "little") + text + data.numbers
