"""Starts the programs of a mode as separate processes, and ends them together."""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass

from rce_fleet.demo.children import Children
from rce_fleet.demo.cloud import Cloud
from rce_fleet.demo.config import DemoConfig, Mode
from rce_fleet.demo.multi import MultiMaster
from rce_fleet.demo.programs import ModePrograms
from rce_fleet.demo.single import SingleMaster
from rce_fleet.drivers.report import WorldReport, read_report

_PROGRAMS: dict[Mode, Callable[[DemoConfig], ModePrograms]] = {
    Mode.CLOUD: Cloud,
    Mode.SINGLE: SingleMaster,
    Mode.MULTI: MultiMaster,
}


@dataclass(frozen=True, slots=True)
class RunningDemo:
    """Everything runs.

    Attributes:
        page: URL of the operator's page.
        config: What it runs.
        children: The programs.
        programs: The mode's own.
    """

    page: str
    config: DemoConfig
    children: Children
    programs: ModePrograms

    def truth(self) -> WorldReport | None:
        """What truly happened in the world until a moment ago."""
        return read_report(self.config.report)


@asynccontextmanager
async def start_demo(config: DemoConfig, show: Callable[[str], None]) -> AsyncIterator[RunningDemo]:
    """Start all programs, and end them all when the block is left.

    Args:
        config: What to run.
        show: Gets every line that a program prints.

    Raises:
        DemoError: A program ended at its start, or did not come up.
        OSError: A program cannot be started, or a file not written.
    """
    programs = _PROGRAMS[config.mode](config)
    async with Children(config.folder, show) as children:
        page = await children.while_alive(programs.start(children))
        yield RunningDemo(page, config, children, programs)
