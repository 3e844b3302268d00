"""``rce demo --slam``: a robot maps a small floor, and the fleet drives on this map."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.demo import run_headless

pytestmark = [pytest.mark.e2e, pytest.mark.real_time("robots"), pytest.mark.needs("pymunk")]

FLOOR = """type octile
height 4
width 5
map
.....
..@..
.....
.....
"""
TIMEOUT_S = 400.0


async def test_a_fleet_drives_on_the_map_that_its_robot_made(tmp_path: Path) -> None:
    (tmp_path / "floor.map").write_text(FLOOR)
    code, report, text = await run_headless(
        *("--slam", "--mode", "single", "--robots", 2, "--seed", 1),
        *("--world", tmp_path / "floor.map", "--blocked-cells", 0),
        timeout=TIMEOUT_S,
    )
    assert code == 0, text
    exploration = report["exploration"]
    assert exploration["explored"] > 0.9  # behind boxes it cannot see all
    assert exploration["right"] > 0.9
    assert exploration["wall_error_m"] < 0.05
    assert all(robot["reached"] for robot in report["robots"])
    assert report["collisions"] == 0
