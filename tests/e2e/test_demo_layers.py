"""The page's layers in ``rce demo``: of robots with masters of their own, and of off-loaded robots."""

from __future__ import annotations

import asyncio
import json

import aiohttp
import pytest
from support.demo import running_demo
from support.ports import free_port

from rce_fleet.station.layers.kinds import LAYERS

pytestmark = [
    pytest.mark.e2e,
    pytest.mark.real_time("robots"),
    pytest.mark.needs("pymunk"),
    pytest.mark.timeout(400),
]

WAIT_S = 240.0
WITHOUT_GOAL = set(LAYERS) - {"plan"}
"""Layers of a robot that stands without a goal."""


async def layers_of(page: str, robot: str, wanted: set[str]) -> dict[str, str]:
    """Ask for layers as the page does, until each had a frame; return those without, and why."""
    missing = dict.fromkeys(wanted, "nothing came")
    async with aiohttp.ClientSession() as session, session.ws_connect(f"{page}api/v1/live") as live:
        try:
            async with asyncio.timeout(WAIT_S):
                async for message in live:
                    if message.type is aiohttp.WSMsgType.BINARY:
                        header = json.loads(message.data[4 : 4 + int.from_bytes(message.data[:4], "little")])
                        missing.pop(header["layer"], None)
                    else:
                        news = message.json()
                        if news["type"] == "state":  # before it, the robot is unknown
                            await live.send_json({"robot": robot, "layers": sorted(wanted)})
                        elif news["type"] == "layer" and news["layer"] in missing:
                            missing[news["layer"]] = news["text"]
                    if not missing:
                        break
        except TimeoutError:
            pass
    return missing


@pytest.mark.parametrize(
    "options", [("--mode", "multi", "--machines", "ports"), ("--offload",)], ids=["multi", "offload"]
)
async def test_all_layers_of_a_standing_robot_are_shown(options: tuple[str, ...]) -> None:
    more = ("--core-port", free_port()) if "multi" in options else ()
    async with running_demo(*options, *more, "--robots", 2, "--no-auto") as demo:
        missing = await layers_of(demo.page, "Robot2", WITHOUT_GOAL)
        assert not missing, (missing, demo.output())
