"""``rce plan``: the file that it writes, and what it says of bad input."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

from rce_fleet.offline.plan_command import plan
from rce_fleet.planning import lacam
from rce_fleet.planning.checker import check_plan
from rce_fleet.planning.independent import DijkstraPlanner
from rce_fleet.planning.lacam import LacamPlanner
from rce_fleet.planning.movingai import read_map

MAP = "type octile\nheight 4\nwidth 6\nmap\n......\n.@@.@.\n.@@.@.\n......\n"
ROWS = ((0, 0, 5, 3), (5, 0, 0, 3), (0, 3, 5, 0), (3, 0, 3, 3))


@pytest.fixture
def files(tmp_path: Path) -> tuple[Path, Path]:
    map_, scen = tmp_path / "floor.map", tmp_path / "floor.scen"
    map_.write_text(MAP)
    rows = [f"0\tfloor.map\t6\t4\t{a}\t{b}\t{c}\t{d}\t1.0" for a, b, c, d in ROWS]
    scen.write_text("version 1\n" + "\n".join(rows) + "\n")
    return map_, scen


def run(*arguments: object) -> tuple[int, str]:
    app = typer.Typer()
    app.command()(plan)
    result = CliRunner().invoke(app, [*map(str, arguments)])
    return result.exit_code, result.output


def test_a_plan_is_written_and_is_right(files: tuple[Path, Path], tmp_path: Path) -> None:
    map_, scen = files
    output = tmp_path / "plan.json"
    code, said = run(map_, "--scen", scen, "--robots", 4, "--seconds", 0.3, "--output", output)
    assert code == 0, said
    report = json.loads(output.read_text())
    assert list(report) == [
        "robots", "compile_s", "first_solution_s", "cost", "lower_bound", "makespan", "conflict_free",
        "paths",
    ]  # fmt: skip
    starts = [y * 6 + x for x, y, _, _ in ROWS]
    goals = [y * 6 + x for _, _, x, y in ROWS]
    assert check_plan(read_map(map_), report["paths"], starts=starts, goals=goals) == []
    assert report["cost"] == sum(len(path) - 1 for path in report["paths"]) >= report["lower_bound"] == 27
    assert report["makespan"] == max(len(path) - 1 for path in report["paths"])


def test_time_that_improves_nothing_is_told(
    files: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The tables of many robots on a large map would fill the memory."""
    monkeypatch.setattr(lacam, "_MAX_IMPROVED", 4 * 18 - 1)
    map_, scen = files
    line = (map_, "--scen", scen, "--robots", 4, "--output", tmp_path / "plan.json")
    code, said = run(*line, "--seconds", 60)
    assert code == 0
    assert "rce plan: --seconds 60 only serves to find a plan" in said
    assert "for 4 robots on this map" in said
    monkeypatch.setattr(lacam, "_MAX_IMPROVED", 4 * 18)
    assert "--seconds" not in run(*line, "--seconds", 0.1)[1]


def test_a_plan_has_a_file_if_none_is_named(
    files: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    code, said = run(files[0], "--lifelong", "--steps", 3, "--robots", 2, "--seed", 1)
    assert (code, said[:10]) == (0, "plan.json:")
    assert json.loads((tmp_path / "plan.json").read_text())["robots"] == 2


def test_a_lifelong_run_names_the_goals(files: tuple[Path, Path], tmp_path: Path) -> None:
    map_, _ = files
    output = tmp_path / "plan.json"
    code, said = run(map_, "--lifelong", "--steps", 30, "--robots", 3, "--seed", 2, "--output", output)
    assert code == 0, said
    report = json.loads(output.read_text())
    assert {len(path) for path in report["paths"]} == {31}
    assert check_plan(read_map(map_), report["paths"]) == []
    assert report["conflict_free"]
    assert 0 < report["lower_bound"] <= report["cost"] <= 3 * report["makespan"] <= 3 * 30
    assert report["tasks"] == sum(map(len, report["goals"]))
    assert report["tasks_per_step"] == pytest.approx(report["tasks"] / 30)
    for path, goals in zip(report["paths"], report["goals"], strict=True):
        assert all(here != there for here, there in pairwise(goals))
        at = 0
        for goal in goals:
            at = path.index(goal, at)


def test_a_plan_keeps_to_lanes(files: tuple[Path, Path], tmp_path: Path) -> None:
    """The goal is behind the robot on a one-way ring: it drives all around."""
    map_, scen = files
    lanes, output = tmp_path / "lanes.yaml", tmp_path / "plan.json"
    lanes.write_text("lanes: [{path: [0, 18, 23, 5, 0], one_way: true}]")
    scen.write_text("version 1\n0\tf\t6\t4\t0\t0\t1\t0\t1\n")
    code, said = run(map_, "--scen", scen, "--robots", 1, "--lanes", lanes, "--output", output)
    assert code == 0, said
    report = json.loads(output.read_text())
    assert report["paths"][0] == [0, 6, 12, 18, 19, 20, 21, 22, 23, 17, 11, 5, 4, 3, 2, 1]
    assert report["cost"] == report["lower_bound"] == 15
    lanes.write_text("lanes: [{path: [0, 7]}]")
    code, said = run(map_, "--scen", scen, "--robots", 1, "--lanes", lanes, "--output", output)
    assert code == 1
    assert f"rce plan: {lanes}: lanes[0].path[1]: cell 7 is neither in the row" in said


def test_conflicts_of_shortest_paths_are_told(files: tuple[Path, Path], tmp_path: Path) -> None:
    """Two robots that change places in an aisle: each one's path is right, both together are not."""
    map_, scen = tmp_path / "lane.map", tmp_path / "lane.scen"
    map_.write_text("type octile\nheight 1\nwidth 4\nmap\n....\n")
    scen.write_text("version 1\n0\tlane.map\t4\t1\t0\t0\t3\t0\t3\n0\tlane.map\t4\t1\t3\t0\t0\t0\t3\n")
    output = tmp_path / "plan.json"
    code, said = run(map_, "--scen", scen, "--robots", 2, "--planner", "dijkstra", "--output", output)
    assert code == 0
    assert "rce plan: the planner 'dijkstra' plans each robot alone: 1 conflicts, the first in step 2" in said
    assert json.loads(output.read_text())["conflict_free"] is False


def test_a_wrong_plan_is_not_written(
    files: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a planner that promises plans without conflicts."""
    plan_alone = DijkstraPlanner().plan
    monkeypatch.setattr(
        LacamPlanner, "plan", lambda _, problem: replace(plan_alone(problem), conflict_free=True)
    )
    map_, scen = files
    scen.write_text("version 1\n0\tf\t6\t4\t0\t0\t5\t0\t5\n0\tf\t6\t4\t5\t0\t0\t0\t5\n")
    code, said = run(map_, "--scen", scen, "--robots", 2, "--output", tmp_path / "plan.json")
    assert code == 1
    assert "the planner 'lacam' made a wrong plan; step 3:" in said
    assert not (tmp_path / "plan.json").exists()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("--robots 4", "--robots 9"), "the scenario has 4 robots; --robots asks for 9"),
        (("--scen {scen}", "--scen {scen}.missing"), "floor.scen.missing"),
        (("--scen {scen}", ""), "a plan needs --scen FILE.scen"),
        (("--robots 4", "--robots 4 --lifelong"), "leave out --scen"),
        (
            ("--scen {scen}", "--lifelong --planner lacam --seconds 0"),
            "its own; leave out --seconds, --planner",
        ),
        (("--robots 4", "--robots 4 --planner best"), "there is no planner 'best'; installed are"),
        (("\t5\t0\t0\t3", "\t0\t0\t0\t3"), "robots 0 and 1 have the same start, cell 0"),
        (("\t5\t0\t0\t3", "\t1\t1\t0\t3"), "line 3: (1, 1) is not a free cell of the map"),
        (
            ("......\n.@@.@.\n.@@.@.\n......", "...@..\n.@@@@.\n.@@@@.\n...@.."),
            "robot 0: no path leads from its start, cell 0, to its goal, cell 23",
        ),
    ],
)
def test_bad_input_is_a_clear_error(
    files: tuple[Path, Path], tmp_path: Path, change: tuple[str, str], said: str
) -> None:
    map_, scen = files
    for file in files:
        file.write_text(file.read_text().replace(*change))
    if "no path" in said:
        scen.write_text("\n".join(scen.read_text().splitlines()[:4]) + "\n")
    line = "{map} --scen {scen} --robots 4 --output {out}"
    if "no path" in said:
        line = line.replace("--robots 4", "--robots 3")
    line = line.replace(*change).format(map=map_, scen=scen, out=tmp_path / "plan.json")
    code, output = run(*line.split())
    assert code == 1
    assert said in output
    assert not (tmp_path / "plan.json").exists()


def test_unreachable_goals_are_found_before_the_search(
    files: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also one of a later block of robots; a search would last until its effort is spent."""

    def search(*_: object) -> None:
        pytest.fail("a plan was searched")

    monkeypatch.setattr(LacamPlanner, "plan", search)
    map_, scen = files
    map_.write_text("type octile\nheight 2\nwidth 52\nmap\n" + "." * 50 + "@.\n" + "." * 50 + "@.\n")
    goals = [*((column, 1) for column in range(40)), (51, 1)]
    rows = [f"0\tfloor.map\t52\t2\t{x}\t0\t{gx}\t{gy}\t1.0" for x, (gx, gy) in enumerate(goals)]
    scen.write_text("version 1\n" + "\n".join(rows) + "\n")
    code, said = run(map_, "--scen", scen, "--robots", 41, "--output", tmp_path / "plan.json")
    assert code == 1
    assert "robot 40: no path leads from its start, cell 40, to its goal, cell 103" in said


def test_too_many_lifelong_robots_are_refused(files: tuple[Path, Path], tmp_path: Path) -> None:
    code, said = run(files[0], "--lifelong", "--robots", 40, "--output", tmp_path / "plan.json")
    assert code == 1
    assert "40 robots do not fit: the map has 18 connected free cells" in said


def test_a_scenario_without_a_plan_is_said_to_have_none(tmp_path: Path) -> None:
    map_, scen = tmp_path / "lane.map", tmp_path / "lane.scen"
    map_.write_text("type octile\nheight 1\nwidth 4\nmap\n....\n")
    scen.write_text("version 1\n0\tlane.map\t4\t1\t0\t0\t3\t0\t3\n0\tlane.map\t4\t1\t3\t0\t0\t0\t3\n")
    code, said = run(map_, "--scen", scen, "--robots", 2, "--seconds", 20, "--output", tmp_path / "o.json")
    assert code == 1
    assert "no plan exists" in said
