"""``rce demo --headless``: everything as separate processes, goals, a cell blocked under way, a report."""

from __future__ import annotations

import asyncio
import signal
import socket
import sys
from functools import partial
from pathlib import Path
from typing import Any

import aiohttp
import psutil
import pytest
from support.demo import LIGHT, clean_folder, environment, run_headless, running_demo
from support.engine import command_line, until

from rce_fleet.demo.scenario import choose_scenario
from rce_fleet.drivers.report import read_report
from rce_fleet.exceptions import StationUnavailableError
from rce_fleet.station.client import StationClient

pytestmark = [
    pytest.mark.e2e,
    pytest.mark.real_time("robots"),
    pytest.mark.needs("pymunk"),
    pytest.mark.timeout(1000),
]

TIMEOUT_S = 400.0


def check(code: int, report: dict[str, Any], text: str, robots: int) -> None:
    """Check that a run was good and its report whole."""
    assert code == 0, text
    assert report["ok"] is True
    assert report["collisions"] == 0
    assert report["duration_s"] > 0
    assert report["engine"]["messages"] > 0
    assert report["engine"]["dropped"] == 0
    assert [robot["id"] for robot in report["robots"]] == [f"Robot{n + 1}" for n in range(robots)]
    for robot in report["robots"]:
        assert robot["reached"] is True
        assert robot["distance_m"] > 0.5
        assert robot["start_cell"] != robot["goal_cell"]
        assert 0 < robot["localization_rmse_m"] < 0.25
        assert robot["localization_rmse_m"] <= robot["localization_max_m"]
        assert robot["recoveries"] >= 0
    assert sum(robot["replans"] for robot in report["robots"]) >= 1
    assert report["blocked_cell"] is not None
    if robots == 1:
        assert report["min_separation_m"] is None
    else:
        assert report["min_separation_m"] > 0.05


async def test_three_robots() -> None:
    """The ways are short, and on the longest a cell can be blocked."""
    check(*await run_headless("--robots", 3, "--seed", 307, timeout=TIMEOUT_S), robots=3)


async def test_blocked_cells_never_cut_off_a_goal(tmp_path: Path) -> None:
    """Two robots drive in one lane, one behind the other: each cell of it is the only way to some goal."""
    world, scen = tmp_path / "lane.map", tmp_path / "lane.scen"
    world.write_text("type octile\nheight 2\nwidth 10\nmap\n@.@@@.@.@@\n..........\n")
    rows = [f"0\tlane.map\t10\t2\t{start}\t1\t{goal}\t1\t5\n" for start, goal in ((0, 5), (3, 8))]
    scen.write_text("version 1\n" + "".join(rows))
    code, report, text = await run_headless(
        *(*LIGHT, "--runtime", "process", "--world", world, "--scen", scen),
        *("--robots", 2, "--blocked-cells", 2),
        timeout=TIMEOUT_S,
    )
    assert code == 0, text
    assert report["blocked_cells"] == [], text
    assert all(robot["reached"] for robot in report["robots"])


async def test_a_robot_keeps_to_its_lanes(tmp_path: Path) -> None:
    """Its goal is the cell behind it, and it drives all around: the planner has the lanes in a container."""
    world, scen, lanes = (tmp_path / name for name in ("ring.map", "ring.scen", "lanes.yaml"))
    world.write_text("type octile\nheight 2\nwidth 6\nmap\n......\n......\n")
    scen.write_text("version 1\n0\tring.map\t6\t2\t1\t0\t0\t0\t1\n")
    lanes.write_text("lanes:\n  - {name: ring, path: [0, 5, 11, 6, 0], one_way: true, width: 0.9}\n")
    code, report, text = await run_headless(
        *(*LIGHT, "--world", world, "--scen", scen, "--robots", 1, "--lanes", lanes),
        timeout=TIMEOUT_S,
    )
    assert code == 0, text
    (robot,) = report["robots"]
    assert robot["reached"]
    assert (robot["start_cell"], robot["goal_cell"]) == (1, 0)
    assert robot["distance_m"] > 10
    assert report["blocked_cells"] == []


async def test_run_that_times_out_reports_it() -> None:
    code, report, text = await run_headless("--robots", 1, timeout=1)
    assert code == 1
    assert report["ok"] is False
    assert "timeout: the run was not complete after 1 s" in text
    assert report["robots"][0]["reached"] is False


async def test_a_taken_port_is_named_with_its_option() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        code, _, text = await run_headless("--port", port, timeout=TIMEOUT_S)
    assert code == 1
    assert f"port {port} is in use; choose another one with --port" in text


async def test_sigterm_ends_a_demo_that_is_still_starting() -> None:
    with clean_folder() as folder:
        process = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "rce_fleet.demo", "--headless", "--robots", "1"),
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.STDOUT,
            env=environment(folder),
        )
        assert process.stdout is not None
        assert b"1 robots" in await process.stdout.readline()
        process.send_signal(signal.SIGTERM)
        assert b"stopped" in await asyncio.wait_for(process.stdout.read(), 30)
        assert await process.wait() == 1, "a run that was ended early is not a good run"


@pytest.mark.needs("bwrap")
async def test_robots_continue_after_parts_of_the_engine_are_killed() -> None:
    async with running_demo(*LIGHT, "--robots", 2, "--runtime", "namespace") as demo:
        (report,) = demo.folder.glob("rce-demo-*/world.json")

        def driven() -> float:
            found = read_report(report)
            return sum(robot.distance_m for robot in found.robots) if found else 0.0

        def has_driven(metres: float) -> bool:
            return driven() > metres

        await until(lambda: has_driven(0.3), timeout=120, what="robots drive")
        for part in ("rce_robot", "rce_master", "rce_container.environment", "rce_container"):
            victims = [
                process
                for process in psutil.Process(demo.process.pid).children(recursive=True)
                if part in command_line(process)
            ]
            assert victims, part
            victims[0].kill()
            before = driven()
            await until(
                partial(has_driven, before + 0.5),
                timeout=120,
                what=f"robots drive on after {part} was killed",
            )
        found = read_report(report)
        assert found is not None
        assert found.collisions.total == 0


async def test_killed_planner_returns_with_goals_and_blocked_cells() -> None:
    async with (
        running_demo(*LIGHT, "--robots", 1, "--seed", 12, "--runtime", "process", "--no-auto") as demo,
        aiohttp.ClientSession() as session,
    ):
        station = StationClient(session, demo.page)
        await until(lambda: states(station, "idle"), timeout=60, what="the robot is in its place")
        (robot,) = (await station.fleet()).robots
        scenario = choose_scenario(1, 12)
        known = {*scenario.starts, *scenario.goals, *scenario.boxes}
        corner = next(cell for cell in scenario.grid.free if cell not in known)
        await station.set_blocked(corner, blocked=True)
        await station.set_goal(robot.id, scenario.goals[0])
        await until(lambda: states(station, "driving"), timeout=60, what="the robot drives")
        (planner,) = [
            process
            for process in psutil.Process(demo.process.pid).children(recursive=True)
            if " ".join(command_line(process)).endswith("fleet_planner.py")
        ]
        planner.kill()
        await until(lambda: states(station, "arrived"), timeout=180, what="the robot is at its goal")
        fleet = await station.fleet()
        assert fleet.robots[0].cell == fleet.robots[0].goal == scenario.goals[0]
        assert corner in fleet.blocked


async def states(station: StationClient, wanted: str) -> bool:
    try:
        fleet = await station.fleet()
    except StationUnavailableError:
        return False
    return bool(fleet.robots) and all(robot.state == wanted for robot in fleet.robots)
