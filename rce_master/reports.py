"""Reports of task sets on their way to the state; those that the store did not take are repeated.

Task sets report each change once. A report that is lost because the store fails for a moment would be missing
until the task set connects again.
"""

from __future__ import annotations

import asyncio
import logging
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, TypeAlias, assert_never

from rce_master.exceptions import EndedError, FencedError, StoreError
from rce_master.state import commands

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from rce_master.state_service import Outcome, StateService

_log = logging.getLogger(__name__)

REPEAT_S = 1.0
"""Time from one attempt to the next."""
_PIECE = 256
"""Reports that are repeated in one transaction."""

Report: TypeAlias = (
    commands.StatusReported
    | commands.StatusPatched
    | commands.SpecRequested
    | commands.EndpointGone
    | commands.FaultReported
    | commands.VolumeRemoved
    | commands.VolumeRestored
    | commands.RobotLeft
    | commands.TaskSetLeft
)


@dataclass(eq=False, slots=True)
class _Report:
    process: str
    subject: str
    command: Report
    is_lost: bool = False
    """Whether the store did not take it, and it is to be repeated."""


class ReportQueue:
    """Hands reports to the state service in the order of arrival.

    Of each endpoint and volume, and of the task set itself, the newest report is kept until it is stored: it
    replaces those before it. A patch of a status cannot be repeated after others, so the whole is asked for.

    Args:
        state_service: Takes the reports.
        ask_status: Asks a task set, by its process name, for the whole status of an endpoint.
    """

    def __init__(self, state_service: StateService, ask_status: Callable[[str, str], None]) -> None:
        self._state_service = state_service
        self._ask_status = ask_status
        self._newest: dict[str, dict[str, _Report]] = {}
        """The newest report that is not stored yet, by process and subject."""

    async def submit(self, process: str, command: Report) -> asyncio.Future[list[Outcome]]:
        """Take a report; waits only while too many commands are waiting already.

        Returns:
            What becomes of it at the first attempt.
        """
        report = _Report(process, _subject_of(command), command)
        if report.subject and not isinstance(command, commands.StatusPatched):
            self._keep(report)
        done = await self._state_service.enqueue([command])
        done.add_done_callback(partial(self._ended, [report]))
        return done

    def forget(self, process: str) -> None:
        """Forget the reports of a task set that connects: it tells all that counts then."""
        self._newest.pop(process, None)

    def repeat_later(self, process: str, command: Report) -> None:
        """Take a report that :meth:`run` is to submit."""
        self._keep(_Report(process, _subject_of(command), command, is_lost=True))

    async def run(self) -> None:
        """Repeat the reports that the store did not take, until cancelled."""
        while True:
            await asyncio.sleep(REPEAT_S)
            await self._repeat()

    async def _repeat(self) -> None:
        lost = [one for reports in self._newest.values() for one in reports.values() if one.is_lost]
        for first in range(0, len(lost), _PIECE):
            # Those that were replaced meanwhile are left out. A full queue would let newer ones go first.
            piece = [one for one in lost[first : first + _PIECE] if self._is_newest(one)]
            if not piece:
                continue
            if self._state_service.is_full:
                return
            done = await self._state_service.enqueue([one.command for one in piece])
            done.add_done_callback(partial(self._ended, piece))
            await asyncio.wait([done])
            if any(isinstance(outcome, StoreError) for outcome in done.result()):
                return

    def _keep(self, report: _Report) -> None:
        reports = self._newest.setdefault(report.process, {})
        reports.pop(report.subject, None)  # the order is that of arrival
        reports[report.subject] = report

    def _is_newest(self, report: _Report) -> bool:
        return self._newest.get(report.process, {}).get(report.subject) is report

    def _ended(self, reports: Sequence[_Report], done: asyncio.Future[list[Outcome]]) -> None:
        for report, outcome in zip(reports, done.result(), strict=True):
            is_lost = isinstance(outcome, StoreError) and not isinstance(outcome, EndedError | FencedError)
            if isinstance(report.command, commands.StatusPatched):
                if is_lost:
                    self._ask_status(report.process, report.subject)
            elif self._is_newest(report):
                if is_lost and not report.is_lost:
                    _log.info("a report of %s is repeated until it is stored", report.process)
                report.is_lost = is_lost
                if not is_lost:
                    self._drop(report)

    def _drop(self, report: _Report) -> None:
        reports = self._newest[report.process]
        del reports[report.subject]
        if not reports:
            del self._newest[report.process]


def _subject_of(command: Report) -> str:
    """Return what a report is about; empty if it changes nothing that is stored."""
    match command:
        case commands.StatusReported():
            return command.status.id
        case commands.StatusPatched():
            return command.patch.status.id
        case commands.EndpointGone():
            return command.id
        case commands.VolumeRemoved() | commands.VolumeRestored():
            return f"volume {command.volume}"
        case commands.TaskSetLeft():
            return "task set"
        case commands.SpecRequested() | commands.FaultReported() | commands.RobotLeft():
            return ""
        case _:
            assert_never(command)
