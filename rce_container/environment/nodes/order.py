"""The order in which nodes start and end, from ``after`` in their specifications. Pure."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping

from rce.model import NodeSpec


class StartOrder:
    """The order of nodes.

    Args:
        specs: All nodes of a container.
    """

    def __init__(self, specs: Iterable[NodeSpec] = ()) -> None:
        self._after: dict[str, tuple[str, ...]] = {spec.tag: spec.after for spec in specs}

    def faults(self) -> dict[str, str]:
        """Return the nodes that can never start because of their order, each with a text for the user."""
        return dict(self._faults())

    def _faults(self) -> Iterator[tuple[str, str]]:
        for tag, befores in self._after.items():
            unknown = [before for before in befores if before not in self._after]
            if unknown:
                yield (
                    tag,
                    f"waits for {unknown[0]!r}, which the container does not have; add it, or change 'after'",
                )
            elif (circle := self._circle(tag)) is not None:
                yield tag, f"waits for itself ({' after '.join(circle)}); change 'after' of one of them"

    def _circle(self, tag: str) -> list[str] | None:
        """Return the shortest cycle from a node over its predecessors back to itself."""
        ways = [[tag]]
        seen = {tag}
        for way in ways:
            for before in self._after.get(way[-1], ()):
                if before == tag:
                    return [*way, tag]
                if before not in seen:
                    seen.add(before)
                    ways.append([*way, before])
        return None


def ready_to_end(leaving: Mapping[str, tuple[str, ...]]) -> set[str]:
    """Return which of the nodes that are to end may end now: those that no other one depends on.

    Args:
        leaving: The nodes that still have to end, with the nodes that they were started after.

    Returns:
        Empty only if no node is to end; all nodes of a cycle.
    """
    needed = {before for tag, befores in leaving.items() for before in befores if before != tag}
    return {tag for tag in leaving if tag not in needed} or set(leaving)


def levels(leaving: Mapping[str, tuple[str, ...]]) -> int:
    """Return how many consecutive rounds it takes to end all nodes."""
    left = dict(leaving)
    count = 0
    while left:
        count += 1
        for tag in ready_to_end(left):
            del left[tag]
    return count
