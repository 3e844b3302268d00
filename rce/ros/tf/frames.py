"""Names of frames. Pure.

The rule of ``tf_prefix`` is that of http://wiki.ros.org/geometry/CoordinateFrameConventions: a name with a
slash at its beginning is global and stands for itself without the slash; any other lives below the prefix.
"""

from __future__ import annotations

PARAMETER = "tf_prefix"
"""The parameter that holds the prefix; it is looked for from the node's own name upwards."""

SEPARATOR = "/"


def strip(frame: str) -> str:
    """Return the name as the tree knows it: without a slash at its beginning."""
    return frame.removeprefix(SEPARATOR)


def resolve(prefix: str, frame: str) -> str:
    """Return the full name of a frame: ``resolve("robot1", "base_link") == "robot1/base_link"``.

    Args:
        prefix: The prefix of the robot's frames; empty for none.
        frame: The name; ``/map`` is ``map`` for every robot.
    """
    root = prefix.strip(SEPARATOR)
    if frame.startswith(SEPARATOR) or not root:
        return strip(frame)
    return f"{root}{SEPARATOR}{frame}"
