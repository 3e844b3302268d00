"""What a stream of tasks is to a run."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol, Self

if TYPE_CHECKING:
    from collections.abc import Collection, Sequence
    from types import TracebackType

    from rce_fleet.station.api import FleetModel


class TaskStream(Protocol):
    """Gives a fleet tasks, and sees what becomes of them. An async context manager."""

    async def __aenter__(self) -> Self: ...

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...

    @property
    def accepted(self) -> int:
        """Number of tasks that the fleet accepted."""

    @property
    def done(self) -> int:
        """Number of those that it has done."""

    @property
    def open(self) -> int:
        """Number of tasks that are accepted, and have not ended."""

    @property
    def lost(self) -> Sequence[str]:
        """Tasks that the fleet accepted and forgot, in words."""

    @property
    def failed(self) -> Sequence[str]:
        """Tasks and requests that came to another end, and why, in words."""

    @property
    def busy(self) -> Collection[str]:
        """Robots that have something to do."""

    async def update(self, fleet: FleetModel, *, more: bool) -> None:
        """See what became of tasks, and send new ones.

        Args:
            fleet: The state of the fleet now.
            more: Whether to send new tasks.
        """

    async def settle(self) -> None:
        """Find out what became of every task, when the run is over."""
