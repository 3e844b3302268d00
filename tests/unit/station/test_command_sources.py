"""How the station finds the robots' interfaces for commands."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

from rce_fleet.station.commands.sources import CommandError, EngineCommandSource

TAGS = [f"command_Robot{number}_emergency_stop" for number in range(50)]


class Items:
    """Gives the interfaces of fifty robots when it is let, and counts how often it is asked."""

    def __init__(self) -> None:
        self.asked = 0
        self.may_answer = asyncio.Event()
        self.error: Exception | None = None

    async def read(self, kind: str) -> list[dict[str, Any]]:
        assert kind == "interfaces"
        self.asked += 1
        await self.may_answer.wait()
        if self.error is not None:
            raise self.error
        return [{"tag": tag, "endpoint": "robots"} for tag in TAGS]


async def test_all_who_ask_meanwhile_share_one_answer() -> None:
    items = Items()
    source = EngineCommandSource(lambda: None, items.read)
    asking = [asyncio.create_task(source.find(tag, "none")) for tag in TAGS]
    given_up = asyncio.create_task(source.find(TAGS[0], "none"))
    await asyncio.sleep(0)
    given_up.cancel()
    items.may_answer.set()
    assert await asyncio.gather(*asking) == [{"robots"}] * len(TAGS)
    assert await source.find(TAGS[0], "none") == {"robots"}
    assert items.asked == 1


async def test_a_failed_answer_is_asked_for_again() -> None:
    items = Items()
    items.may_answer.set()
    items.error = OSError("the master is away")
    source = EngineCommandSource(lambda: None, items.read)
    asking = [asyncio.create_task(source.find(tag, "none")) for tag in TAGS[:2]]
    for task in asking:
        with pytest.raises(CommandError, match="the master is away"):
            await task
    items.error = None
    assert await source.find(TAGS[0], "none") == {"robots"}
    assert items.asked == 2
