"""Enforces the limits of one incarnation of a container, and reports killed processes."""

from __future__ import annotations

import asyncio

from rce.model import MEGABYTE, Resources
from rce_container.exceptions import LimitError
from rce_container.limits.base import ControlGroup, SlotSettings, in_megabytes, limits_of

_REACHED = 0.9
"""Memory that never reached this share of its limit means: the limit did not cause the kill."""


class LimitEnforcer:
    """Enforces the limits of one control group.

    The kernel only counts the processes that it kills for lack of memory, before it kills them. The caller
    that finds a killed process asks :meth:`claim`. :meth:`review` reports unclaimed kills later: processes
    that nodes had started.

    Args:
        tag: The container's tag, for texts.
        control_group: The control group; it belongs to this object.
        settings: How much a slot is.
    """

    def __init__(self, tag: str, control_group: ControlGroup, settings: SlotSettings) -> None:
        self.control_group = control_group
        self._tag = tag
        self._settings = settings
        self._claimed, self._refused = control_group.troubles()
        self._unclaimed = 0
        self._is_refusing = False
        self._told = ""
        self._size = 1
        self._applying = asyncio.Lock()

    async def apply(self, resources: Resources) -> str:
        """Apply the limits that follow from the container's request.

        Returns:
            Why they cannot be applied, as text for the user; the old limits stay then. Empty on success, or
            if the same was reported before.
        """
        async with self._applying:
            self._size = max(1, resources.size)
            try:
                await asyncio.to_thread(self.control_group.apply, limits_of(resources, self._settings))
            except LimitError as error:
                text = f"{error}; the limits stay as they were"
            else:
                text = ""
            text, self._told = ("" if text == self._told else text), text
            return text

    def claim(self) -> str:
        """Return why the kernel killed a process, if the reason is memory; each kill is claimed once."""
        if self.control_group.troubles().oom_kills <= self._claimed:
            return ""
        self._claimed += 1
        self._unclaimed = 0
        return self._out_of_memory()

    def claim_all(self) -> str:
        """Return why the whole container ended, if a reason is memory."""
        text = self.claim()
        self._claimed = max(self._claimed, self.control_group.troubles().oom_kills)
        return text

    def review(self) -> list[str]:
        """Look for problems since the last call.

        Returns:
            Texts for the user.
        """
        troubles = self.control_group.troubles()
        texts = []
        unclaimed = troubles.oom_kills - self._claimed
        if settled := min(unclaimed, self._unclaimed):
            self._claimed += settled
            killed = "a process that a node started was" if settled == 1 else f"{settled} processes were"
            texts.append(f"{killed} killed: {self._out_of_memory()}")
        self._unclaimed = unclaimed - settled
        refusing = troubles.refused_forks > self._refused
        if refusing and not self._is_refusing:
            texts.append(self._out_of_processes())
        self._is_refusing, self._refused = refusing, troubles.refused_forks
        return texts

    async def end(self) -> None:
        """Kill all processes of the control group.

        Raises:
            KillError: A process does not end.
        """
        await asyncio.to_thread(self.control_group.kill)

    async def remove(self) -> None:
        """Remove the control group.

        Raises:
            LimitError: It is not empty.
        """
        await asyncio.to_thread(self.control_group.remove)

    def _out_of_memory(self) -> str:
        limit = self.control_group.limits.memory
        peak = self.control_group.usage().memory_peak
        if not limit or 0 < peak < _REACHED * limit:
            return "out of memory: its machine has no more"
        more = 2 * -(-limit // MEGABYTE)
        return (
            f"out of memory: the container's limit of {in_megabytes(limit)}; "
            f"ask for more with `rce resize {self._tag} --memory {more}M`"
        )

    def _out_of_processes(self) -> str:
        limit = self.control_group.limits.processes
        return (
            f"its limit of {limit} processes and threads is reached, so it cannot start more;"
            f" ask for more slots with `rce resize {self._tag} --size {self._size + 1}`"
        )
