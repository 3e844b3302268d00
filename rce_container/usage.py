"""What containers consume, read from ``/proc``."""

from __future__ import annotations

from collections.abc import Mapping

from rce.control.model import EndpointUsage, InterfaceUsage
from rce_container.environment import proc
from rce_container.runtimes.base import Handle

_PSS_EVERY = 5
"""A process's share of memory costs time to read, so it is read anew in every fifth measurement only."""


class UsageMeter:
    """Measures containers, each by its processes."""

    def __init__(self) -> None:
        self._shares: dict[tuple[int, int], int] = {}
        self._round = 0

    def measure(
        self, containers: Mapping[str, tuple[Handle, Mapping[str, InterfaceUsage]]]
    ) -> dict[str, EndpointUsage]:
        """Measure all containers.

        Args:
            containers: Processes and counters of the interfaces, by id.

        Returns:
            The usage by id. Memory is the proportional share (PSS), or the resident size where that may not
            be read.
        """
        self._round += 1
        processes = proc.table()
        shares: dict[tuple[int, int], int] = {}
        usage = {}
        for id_, (handle, counters) in containers.items():
            own = handle.members(processes)
            for process in own:
                shares[process.pid, process.start] = self._share(process)
            usage[id_] = EndpointUsage(
                interfaces=dict(counters),
                cpu_s=round(sum(process.cpu_s for process in own), 3),
                memory=sum(shares[process.pid, process.start] for process in own),
                processes=len(own),
            )
        self._shares = shares
        return usage

    def _share(self, process: proc.Process) -> int:
        known = self._shares.get((process.pid, process.start))
        if known is not None and (process.pid + self._round) % _PSS_EVERY:
            return known
        share = proc.proportional(process.pid)
        return process.resident if share is None else share
