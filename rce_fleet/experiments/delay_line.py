"""One direction of a link that delays and loses frames, as a wireless LAN does."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from math import inf
from random import Random


@dataclass(frozen=True, slots=True)
class LinkShape:
    """How a link treats frames, in each direction.

    Attributes:
        delay: Seconds.
        jitter: Largest difference from the delay, seconds; each frame's is uniform. Frames keep their order.
        loss: Share of frames that are lost, each independently of the others; 1: the link is cut.
    """

    delay: float = 0.0
    jitter: float = 0.0
    loss: float = 0.0

    def __post_init__(self) -> None:
        if not 0 <= self.jitter <= self.delay or self.delay == inf:
            raise ValueError(
                f"jitter and delay need 0 <= jitter <= delay, not {self.jitter:g} and {self.delay:g}"
            )
        if not 0 <= self.loss <= 1:
            raise ValueError(f"the share of lost frames must be within 0 .. 1, not {self.loss:g}")


class DelayLine:
    """Holds frames until their time.

    Args:
        shape: How it treats them.
        seed: Of jitter and loss.
        capacity: Frames that it holds at most; further ones are lost, as in a full queue.

    Attributes:
        carried: Frames that came out.
        lost: Frames that were lost.
    """

    def __init__(self, shape: LinkShape, seed: int = 0, capacity: int = 10_000) -> None:
        self._shape = shape
        self._random = Random(seed)  # noqa: S311 - not for secrets
        self._capacity = capacity
        self._held: deque[tuple[float, bytes]] = deque()
        self.carried = 0
        self.lost = 0

    def reshape(self, shape: LinkShape) -> None:
        """Treat further frames in another way; those that are held come out first."""
        self._shape = shape

    @property
    def next_at(self) -> float:
        """When the next frame comes out, seconds; ``inf``: none is held."""
        return self._held[0][0] if self._held else inf

    def put(self, frame: bytes, now: float) -> None:
        """Take a frame in."""
        shape = self._shape
        if self._random.random() < shape.loss or len(self._held) >= self._capacity:
            self.lost += 1
            return
        at = now + shape.delay + self._random.uniform(-shape.jitter, shape.jitter)
        self._held.append((max(at, self._held[-1][0]) if self._held else at, frame))

    def take(self, now: float) -> list[bytes]:
        """Return the frames whose time has come."""
        found = []
        while self._held and self._held[0][0] <= now:
            found.append(self._held.popleft()[1])
        self.carried += len(found)
        return found
