"""The tree of frames over the last seconds, and lookups in it. Pure: no I/O, no clock.

Results are those of ROS's tf2. Times in lookups are :class:`~rce.ros.types.Time`; zero, or None, means the
latest time at which all edges of the path are known.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from difflib import get_close_matches

from rce.ros.tf.edges import Edge, Sample, StaticEdge, TimedEdge
from rce.ros.tf.exceptions import (
    ConnectivityError,
    ExtrapolationError,
    FrameLoopError,
    TransformError,
    UnknownFrameError,
)
from rce.ros.tf.frames import strip
from rce.ros.tf.stamped import StampedTransform
from rce.ros.tf.transform import Transform
from rce.ros.types.values import NANOSECONDS, Time

CACHE_TIME = 10.0
"""Seconds that the buffer reaches back from each frame's newest transform."""

_Place = Callable[[str], Sample]
"""Gives a frame's place below its parent."""


class Buffer:
    """The known transforms of all frames.

    Invariant: every parent and child of an inserted transform is in :attr:`frames`.
    """

    def __init__(self, cache_time: float = CACHE_TIME) -> None:
        self.cache_time = cache_time
        self._edges: dict[str, Edge] = {}
        self._frames: dict[str, None] = {}

    def __repr__(self) -> str:
        return f"<Buffer {len(self._frames)} frames>"

    @property
    def frames(self) -> tuple[str, ...]:
        """The names of all frames, in the order in which they came."""
        return tuple(self._frames)

    @property
    def parents(self) -> Mapping[str, str]:
        """Each frame's present parent; roots are missing."""
        return {child: edge.latest.parent for child, edge in self._edges.items()}

    # Telling

    def insert(self, stamped: StampedTransform, *, static: bool = False) -> bool:
        """Take a transform.

        Args:
            stamped: The edge.
            static: It is valid at all times; its stamp is ignored.

        Returns:
            False if it is older than the cache reaches, or its time is known already.

        Raises:
            BadTransformError: It cannot be an edge of a tree.
        """
        stamped.check()
        parent, child = strip(stamped.parent), strip(stamped.child)
        transform = Transform(stamped.transform.translation, stamped.transform.rotation.normalized())
        self._frames.setdefault(child)
        self._frames.setdefault(parent)
        if static:
            self._edges[child] = StaticEdge(parent, transform)
            return True
        edge = self._edges.get(child)
        if not isinstance(edge, TimedEdge):
            edge = self._edges[child] = TimedEdge(round(self.cache_time * NANOSECONDS))
        return edge.insert(Sample(stamped.stamp.to_nsec(), parent, transform))

    def clear(self) -> None:
        """Remove all transforms except static ones; for a time that begins again."""
        self._edges = {child: edge for child, edge in self._edges.items() if isinstance(edge, StaticEdge)}
        self._frames = {}
        for child, edge in self._edges.items():
            self._frames |= {child: None, edge.latest.parent: None}

    # Asking

    def lookup(self, target: str, source: str, time: Time | None = None) -> StampedTransform:
        """Return ``target_from_source``.

        Args:
            target: The frame to take coordinates to.
            source: The frame to take them from.
            time: When; zero or None: the latest time that all edges of the path have in common.

        Returns:
            The transform with its time; zero if it is valid at all times.

        Raises:
            UnknownFrameError: The frame does not exist.
            ConnectivityError: The two are in different trees.
            ExtrapolationError: The time is not within the cache.
            FrameLoopError: The frames are not a tree.
        """
        target, source = self._known(target), self._known(source)
        moment = self._moment(target, source, time)
        up, down = self._path(target, source, lambda frame: self._edges[frame].at(frame, moment))
        target_from_source = _chain(down).inverse() @ _chain(up)
        return StampedTransform(target, source, target_from_source, Time(*divmod(moment, NANOSECONDS)))

    def lookup_full(
        self,
        target: str,
        target_time: Time | None,
        source: str,
        source_time: Time | None,
        fixed: str,
    ) -> StampedTransform:
        """Return ``target_from_source`` between two times: from the source then to the target now.

        Args:
            target: The frame to take coordinates to.
            target_time: Its time; the answer has it.
            source: The frame to take them from.
            source_time: Its time.
            fixed: A frame that does not move between the two times, such as ``map`` or ``odom``.

        Raises:
            TransformError: As for :meth:`lookup`.
        """
        fixed_from_source = self.lookup(fixed, source, source_time)
        target_from_fixed = self.lookup(target, fixed, target_time)
        return StampedTransform(
            target_from_fixed.parent,
            fixed_from_source.child,
            target_from_fixed.transform @ fixed_from_source.transform,
            target_from_fixed.stamp,
        )

    def can_transform(self, target: str, source: str, time: Time | None = None) -> bool:
        """Return whether :meth:`lookup` has an answer."""
        try:
            self.lookup(target, source, time)
        except TransformError:
            return False
        return True

    def latest_common_time(self, target: str, source: str) -> Time:
        """Return the latest time at which all edges between two frames are known; zero: they always hold.

        Raises:
            UnknownFrameError: The frame does not exist.
            ConnectivityError: The two are in different trees.
            FrameLoopError: The frames are not a tree.
        """
        moment = self._moment(self._known(target), self._known(source), None)
        return Time(*divmod(moment, NANOSECONDS))

    def describe(self) -> str:
        """Return the trees as text: a line per frame, below its parent, with the times known."""
        parents = self.parents
        children: dict[str | None, list[str]] = {}
        for frame in self._frames:
            children.setdefault(parents.get(frame), []).append(frame)
        lines: list[str] = []

        def add(frame: str, depth: int) -> None:
            lines.append("  " * depth + frame + _known_times(self._edges.get(frame)))
            for child in children.get(frame, ()):
                add(child, depth + 1)

        for root in children.get(None, ()):
            add(root, 0)
        return "\n".join(lines)

    # Walking the tree

    def _known(self, frame: str) -> str:
        name = strip(frame)
        if name not in self._frames:
            raise UnknownFrameError(name, get_close_matches(name, self._frames))
        return name

    def _moment(self, target: str, source: str, time: Time | None) -> int:
        """Return the time of a question in nanoseconds: the one given, or the latest common one."""
        if time:
            return time.to_nsec()
        if target == source:
            edge = self._edges.get(target)
            return edge.latest.time if edge is not None else 0
        up, down = self._path(target, source, lambda frame: self._edges[frame].latest)
        return min((sample.time for sample in (*up, *down) if sample.time), default=0)

    def _path(self, target: str, source: str, place: _Place) -> tuple[list[Sample], list[Sample]]:
        """Return the places on the way from source and from target to the frame where the ways meet."""
        up, up_end = self._way_up(source, target, place)
        if up_end.frame == target:
            return up, []
        down, down_end = self._way_up(target, source, place)
        meeting = {frame: index for index, frame in enumerate(up_end.passed)}
        for index, frame in enumerate(down_end.passed):
            if frame in meeting:
                return up[: meeting[frame]], down[:index]
        for end in (up_end, down_end):
            if end.obstacle is not None:
                self._moment(target, source, None)  # a missing connection is the better reason
                raise end.obstacle
        raise ConnectivityError(target, down_end.frame, source, up_end.frame)

    def _way_up(self, start: str, goal: str, place: _Place) -> tuple[list[Sample], _End]:
        """Walk towards the root until the goal, the root, or a place that is not known at the time."""
        places: list[Sample] = []
        passed: dict[str, None] = {start: None}
        frame = start
        while frame != goal and frame in self._edges:
            try:
                sample = place(frame)
            except ExtrapolationError as error:
                return places, _End(frame, passed, error)
            places.append(sample)
            frame = sample.parent
            if frame in passed:
                raise FrameLoopError([*passed, frame])
            passed[frame] = None
        return places, _End(frame, passed, None)


class _End:
    """The end of a path towards the root, the frames on it, and why it did not reach the root."""

    __slots__ = ("frame", "obstacle", "passed")

    def __init__(self, frame: str, passed: dict[str, None], obstacle: ExtrapolationError | None) -> None:
        self.frame = frame
        self.passed = passed
        self.obstacle = obstacle


def _chain(samples: list[Sample]) -> Transform:
    """Return ``top_from_bottom`` of places that follow each other upwards."""
    result = Transform()
    for sample in samples:
        result = sample.transform @ result
    return result


def _known_times(edge: Edge | None) -> str:
    if edge is None:
        return ""
    if not isinstance(edge, TimedEdge):
        return " (static)"
    first, last = edge.samples[0].time / NANOSECONDS, edge.samples[-1].time / NANOSECONDS
    return f" ({first:.3f} to {last:.3f})"
