"""Errors of transforms.

::

    RosError
    +-- TransformError
        +-- UnknownFrameError      no transform has such a frame (also a LookupError)
        +-- ConnectivityError      two frames are in different trees
        +-- FrameLoopError         the frames form a cycle, not a tree
        +-- ExtrapolationError     the time is before or after what is known of an edge
        +-- TransformTimeoutError  no answer in time; the cause is one of the above (also a TimeoutError)
        +-- BadTransformError      a transform that cannot be taken (also a ValueError)
"""

from __future__ import annotations

from collections.abc import Sequence

from rce.ros.errors import RosError

NANOSECONDS = 1_000_000_000


class TransformError(RosError):
    """Base of all errors of :mod:`rce.ros.tf`."""


class UnknownFrameError(TransformError, LookupError):
    """No transform has the frame.

    Attributes:
        frame: The frame.
        similar: Names of known frames that look like it.
    """

    def __init__(self, frame: str, similar: Sequence[str] = ()) -> None:
        super().__init__(frame, similar)
        self.frame = frame
        self.similar = tuple(similar)

    def __str__(self) -> str:
        hint = f"; similar ones are {', '.join(self.similar)}" if self.similar else ""
        return f"there is no frame {self.frame!r}{hint}"


class ConnectivityError(TransformError):
    """Two frames are in different trees.

    Attributes:
        target: The frame to transform to.
        target_root: The root of its tree.
        source: The frame to transform from.
        source_root: The root of its tree.
    """

    def __init__(self, target: str, target_root: str, source: str, source_root: str) -> None:
        super().__init__(target, target_root, source, source_root)
        self.target = target
        self.target_root = target_root
        self.source = source
        self.source_root = source_root

    def __str__(self) -> str:
        return (
            f"{self.source!r} and {self.target!r} are not connected: "
            f"they are in the trees of {self.source_root!r} and {self.target_root!r}"
        )


class FrameLoopError(TransformError):
    """The frames form a cycle.

    Attributes:
        frames: The frames, each followed by its parent.
    """

    def __init__(self, frames: Sequence[str]) -> None:
        super().__init__(frames)
        self.frames = tuple(frames)

    def __str__(self) -> str:
        return f"the frames form a circle: {' > '.join(self.frames)}"


class ExtrapolationError(TransformError):
    """A time is not within what is known of an edge of the tree.

    Attributes:
        child: The edge's child.
        parent: Its parent.
        time: The requested time, nanoseconds.
        earliest: The first time known, nanoseconds.
        latest: The last time known, nanoseconds.
    """

    def __init__(self, child: str, parent: str, time: int, earliest: int, latest: int) -> None:
        super().__init__(child, parent, time, earliest, latest)
        self.child = child
        self.parent = parent
        self.time = time
        self.earliest = earliest
        self.latest = latest

    @property
    def is_future(self) -> bool:
        """Whether the time is after all known times: waiting may help."""
        return self.time > self.latest

    def __str__(self) -> str:
        if self.is_future:
            distance, word, end = self.time - self.latest, "after", "last"
        else:
            distance, word, end = self.earliest - self.time, "before", "first"
        return (
            f"{seconds_text(self.time)} is {distance / NANOSECONDS:.3f} s {word} the {end} transform from "
            f"{self.child!r} to {self.parent!r} (known from {seconds_text(self.earliest)} "
            f"to {seconds_text(self.latest)})"
        )


class TransformTimeoutError(TransformError, TimeoutError):
    """A transform did not become known in time.

    Attributes:
        timeout: How long was waited, seconds.
        reason: Why it is not known.
    """

    def __init__(self, timeout: float, reason: TransformError) -> None:
        super().__init__(timeout, reason)
        self.timeout = timeout
        self.reason = reason

    def __str__(self) -> str:
        return f"waited {self.timeout:g} s: {self.reason}"


class BadTransformError(TransformError, ValueError):
    """A transform that cannot be taken."""


def seconds_text(nanoseconds: int) -> str:
    """Return a time as ``seconds.nanoseconds``, without loss."""
    secs, nsecs = divmod(nanoseconds, NANOSECONDS)
    return f"{secs}.{nsecs:09d}"
