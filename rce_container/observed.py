"""What a container's environment reports, as it is seen from outside the container."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import msgspec

from rce.control import EndpointStatus, NodeStatus, ObservedStatus, StatusPatch
from rce_container import intake
from rce_container.environment import proc

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

_LOOK_AGAIN_S = 1.0
"""Seconds before a process that was not found is searched for again."""


class OuterStatus:
    """The reported status of one incarnation, with the pids that the machine sees.

    Args:
        pids: Return the pids of the container's processes as the machine sees them; None if the environment
            reports these.
        clock: Seconds of a monotonic clock.
    """

    def __init__(
        self, pids: Callable[[], Iterable[int]] | None, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._list_pids = pids
        self._clock = clock
        self._observed: ObservedStatus | None = None
        self._pids: dict[int, int] = {}
        """Pid inside the container to pid outside."""
        self._missing: set[int] = set()
        """Pids inside that the newest search did not find."""
        self._looked = 0.0
        """When it was."""

    @property
    def node_pids(self) -> dict[str, int]:
        """The pids of the nodes' first processes by tag."""
        return {node.tag: node.pid for node in self._observed.header.nodes} if self._observed else {}

    @property
    def whole(self) -> EndpointStatus | None:
        """The newest status; None before the first report."""
        return self._observed.whole if self._observed is not None else None

    def replace(self, status: EndpointStatus, pace: intake.Pace) -> EndpointStatus:
        """Take over a whole report, and return it as seen from outside.

        Args:
            status: The report, sanitized.
            pace: Pays for the work that it causes.
        """
        status = self._outside(status, pace)
        self._observed = ObservedStatus(status, intake.MAX_CONNECTIONS)
        return status

    def patch(self, patch: StatusPatch, pace: intake.Pace) -> StatusPatch | None:
        """Take over a patch, and return it as seen from outside; None before the first report."""
        if self._observed is None:
            return None
        patch = msgspec.structs.replace(patch, status=self._outside(patch.status, pace))
        self._observed.patch(patch)
        return patch

    def _outside(self, status: EndpointStatus, pace: intake.Pace) -> EndpointStatus:
        if self._list_pids is None:
            return status
        return msgspec.structs.replace(status, nodes=self._with_outer_pids(status, self._list_pids, pace))

    def _with_outer_pids(
        self, status: EndpointStatus, pids: Callable[[], Iterable[int]], pace: intake.Pace
    ) -> tuple[NodeStatus, ...]:
        unknown = {node.pid for node in status.nodes if node.pid} - self._pids.keys()
        now = self._clock()
        if unknown - (self._missing if now - self._looked < _LOOK_AGAIN_S else set()):
            found = list(pids())
            pace.pay(intake.PER_LOOK + intake.PER_PROCESS * len(found))
            self._pids = {proc.inner_pid(pid): pid for pid in found}
            self._missing = unknown - self._pids.keys()
            self._looked = now
        return tuple(
            msgspec.structs.replace(node, pid=self._pids.get(node.pid, 0)) if node.pid else node
            for node in status.nodes
        )
