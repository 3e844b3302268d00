"""Nodes that a person starts tell their warnings on the terminal."""

from __future__ import annotations

import asyncio
import os
import sys
from pathlib import Path

import pytest
from support.processes import finish

from rce.ros.core import Core

RCE = str(Path(sys.executable).parent / "rce")
PLANNER = ("fleet", "fleet_planner.py")
LAUNCH = """<launch>
  <node pkg="fleet" type="fleet_planner.py" name="fleet_planner"><param name="wals" value="3"/></node>
</launch>
"""


async def printed(core: Core, *words: str, until: bytes = b"", **variables: str) -> tuple[bytes, int | None]:
    """Run a program until it prints something, or ends; return what it printed, and its exit code."""
    process = await asyncio.create_subprocess_exec(
        *(RCE, *words),
        env={**os.environ, "ROS_MASTER_URI": core.uri, **variables},
        stdout=asyncio.subprocess.DEVNULL,
        stderr=asyncio.subprocess.PIPE,
    )
    assert process.stderr is not None
    shown = b""
    try:
        async with asyncio.timeout(60):
            async for line in process.stderr:
                shown += line
                if until and until in line:
                    return shown, None
            return shown, await process.wait()
    finally:
        await finish(process)


async def test_rce_run_shows_warnings() -> None:
    async with Core(port=0) as core:
        text = b"unknown parameter wals; did you mean walls?"
        shown, _ = await printed(core, "run", *PLANNER, "_wals:=[3]", until=text)
        assert b"WARNING ros.fleet_planner: " + text in shown


async def test_rce_launch_shows_warnings(tmp_path: Path) -> None:
    file = tmp_path / "one.launch"
    file.write_text(LAUNCH)
    home = {"ROS_HOME": str(tmp_path), "ROS_LOG_DIR": str(tmp_path / "log")}
    async with Core(port=0) as core:
        text = b"WARNING ros.fleet_planner: unknown parameter wals; did you mean walls?"
        shown, _ = await printed(core, "launch", str(file), until=text, **home)
        assert text in shown


@pytest.mark.parametrize("shows", ["yes", "no"])
async def test_bad_parameters_end_the_planner_with_one_line(shows: str) -> None:
    """With ``RCE_SHOW_WARNINGS=no``, only the reason of the end is printed."""
    async with Core(port=0) as core:
        shown, code = await printed(core, "run", *PLANNER, "_rows:=-2", "_wals:=[3]", RCE_SHOW_WARNINGS=shows)
    assert code == 2
    assert b"fleet_planner: a map needs at least one row and one column, not -2 x 8\n" in shown
    assert b"Traceback" not in shown
    assert (b"wals" in shown) == (shows == "yes")


async def test_move_client_waits_for_the_planners_grid_if_its_own_is_wrong() -> None:
    async with Core(port=0) as core:
        text = b"the grid on /fleet/map is waited for instead: the parameter rows must be a number"
        words = ("run", "fleet", "move_client.py", "__ns:=Robot1", "_rows:=x", "_anwsers:=true")
        shown, _ = await printed(core, *words, until=text)
    assert b"unknown parameter anwsers; did you mean answers?" in shown
