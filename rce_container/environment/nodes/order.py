"""In which order nodes start and end: what ``after`` of their specifications makes of them. Pure."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping

from rce.model.specs import NodeSpec


class StartOrder:
    """Who comes after whom.

    Args:
        specs: All nodes of a container.
    """

    def __init__(self, specs: Iterable[NodeSpec] = ()) -> None:
        self._after: dict[str, tuple[str, ...]] = {spec.tag: spec.after for spec in specs}

    def faults(self) -> dict[str, str]:
        """Which nodes can never start, by their own order alone, each with a text for the user."""
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
        """The shortest way from a node over those before it back to itself."""
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
    """Which of the nodes that are to end may do so now: those that no other one of them comes after.

    Args:
        leaving: The nodes that are to end and have not yet, with what they were started after.

    Returns:
        Never nothing, unless nothing is to end: of nodes in a circle, all.
    """
    needed = {before for tag, befores in leaving.items() for before in befores if before != tag}
    return {tag for tag in leaving if tag not in needed} or set(leaving)


def levels(leaving: Mapping[str, tuple[str, ...]]) -> int:
    """How many rounds it takes to end all, each beginning when the one before is over."""
    left = dict(leaving)
    count = 0
    while left:
        count += 1
        for tag in ready_to_end(left):
            del left[tag]
    return count
