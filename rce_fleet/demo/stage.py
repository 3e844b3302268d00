"""Sets the stage: starts the programs of a mode as separate processes, and ends them together."""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass

from rce_fleet.demo.children import Children
from rce_fleet.demo.cloud import Cloud
from rce_fleet.demo.multi import MultiMaster
from rce_fleet.demo.play import Mode, Play
from rce_fleet.demo.setting import Setting
from rce_fleet.demo.single import SingleMaster
from rce_fleet.drivers.report import WorldReport, read_report

_SETTINGS: dict[Mode, Callable[[Play], Setting]] = {
    Mode.CLOUD: Cloud,
    Mode.SINGLE: SingleMaster,
    Mode.MULTI: MultiMaster,
}


@dataclass(frozen=True, slots=True)
class Stage:
    """Everything runs.

    Attributes:
        page: URL of the operator's page.
        play: What is played.
        children: The programs.
        setting: The mode's own.
    """

    page: str
    play: Play
    children: Children
    setting: Setting

    def truth(self) -> WorldReport | None:
        """What truly happened in the world until a moment ago."""
        return read_report(self.play.report)


@asynccontextmanager
async def set_stage(play: Play, show: Callable[[str], None]) -> AsyncIterator[Stage]:
    """Start all programs, and end them all when the block is left.

    Args:
        play: What is to be played.
        show: Gets every line that a program prints.

    Raises:
        DemoError: A program ended at its start, or did not come up.
        OSError: A program cannot be started, or a file not written.
    """
    setting = _SETTINGS[play.mode](play)
    async with Children(play.folder, show) as children:
        page = await children.while_alive(setting.start(children))
        yield Stage(page, play, children, setting)
