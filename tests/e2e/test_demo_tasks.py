"""``rce demo --headless --duration``: light robots that share containers do tasks while the planner dies."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.demo import run_headless

pytestmark = [pytest.mark.e2e, pytest.mark.real_time("robots"), pytest.mark.needs("pymunk")]


FLOOR = ["......", ".@@...", "......", "...@@.", "......"]
"""A small warehouse: its ways are so short that tasks are done before and after the planner's deaths."""


async def test_light_robots_do_tasks_while_the_planner_dies(tmp_path: Path) -> None:
    world = tmp_path / "floor.map"
    world.write_text("\n".join(["type octile", f"height {len(FLOOR)}", "width 6", "map", *FLOOR]) + "\n")
    code, report, text = await run_headless(
        *("--world", world, "--robots", 4, "--full-stack", 0, "--robots-per-container", 2),
        *("--duration", 24),
        timeout=400,
    )
    assert code == 0, text
    assert report["ok"] is True
    assert report["faults"] == []
    assert report["collisions"] == 0
    assert report["tasks_done"] > 0
    assert (report["tasks_lost"], report["tasks_failed"]) == (0, 0)
    assert report["tasks_accepted"] == report["tasks_done"] + report["tasks_open"]
    assert report["tasks_per_hour"] > 0
    assert report["planner_kills"] == 2
    assert 0 < report["longest_standstill_s"] <= 60
    assert report["real_time_factor"] > 0
    assert len(report["robots"]) == 4
