"""Options of ``rce demo`` that are refused before anything is started."""

from __future__ import annotations

import asyncio
import os
import sys
import termios
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

from rce_fleet.demo import headless
from rce_fleet.demo.command import demo
from rce_fleet.demo.config import DemoConfig
from rce_fleet.demo.exceptions import DemoError
from rce_fleet.demo.headless import RunReport
from rce_fleet.demo.leader_key import leader_key
from rce_fleet.demo.resources import Ports

app = typer.Typer()
app.command()(demo)


@pytest.mark.parametrize("port", ["-5", "65536"])
def test_ports_that_cannot_be_are_usage_errors(port: str) -> None:
    found = CliRunner().invoke(app, ["--headless", "--port", port])
    assert (found.exit_code, "Invalid value for '--port'" in found.output) == (2, True), found.output


def test_masters_ports_after_the_last_one_are_refused() -> None:
    with pytest.raises(DemoError, match="65536 cannot be a port; choose another one with --http-port"):
        Ports(http=65534, control=0).in_rows(3)


@pytest.mark.parametrize("is_ours", [True, False])
async def test_keys_are_read_in_the_foreground_only(monkeypatch: pytest.MonkeyPatch, is_ours: bool) -> None:
    """A program in the background (``rce demo --replicas 3 &``) was stopped by the terminal."""
    ours, other = os.openpty()
    monkeypatch.setattr(os, "tcgetpgrp", lambda _: os.getpgrp() if is_ours else os.getpgrp() + 1)
    with os.fdopen(ours, "rb"), os.fdopen(other) as terminal, monkeypatch.context() as patch:
        patch.setattr(sys, "stdin", terminal)
        with leader_key((), print):
            modes = termios.tcgetattr(other)[3]
            assert bool(modes & termios.ICANON) is not is_ours
        assert termios.tcgetattr(other)[3] & termios.ICANON


async def test_a_demo_without_a_standard_input_has_no_key(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdin", None)
    with leader_key((), print):
        pass


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--report", "no-such-folder/report.json"), "is not in a folder that exists"),
        (("--report", "."), "is a folder"),
        (("--duration", "60", "--timeout", "60"), "--timeout 60 ends the run before its --duration of 60 s"),
        (("--duration", "60", "--mode", "single"), "use --mode cloud"),
        (
            ("--duration", "2"),
            "--duration 2 is too short to kill the planner 2 times with 3 robots: give at least 3 s",
        ),
        (("--duration", "60", "--blocked-cells", "2"), "drives to one goal: omit --duration"),
        (("--state-dir", "/dev/null/state"), "--state-dir /dev/null/state cannot be used: Not a directory"),
    ],
)
def test_headless_options_that_cannot_be_met_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, options: tuple[str, ...], words: str
) -> None:
    """A report that could not be written was a traceback after the run, and its numbers were lost."""
    monkeypatch.chdir(tmp_path)
    found = CliRunner().invoke(app, ["--headless", *options])
    assert (found.exit_code, words in found.output) == (1, True), found.output


def test_blocked_cells_need_a_headless_run() -> None:
    found = CliRunner().invoke(app, ["--blocked-cells", "2"])
    assert found.exit_code == 1
    assert "--blocked-cells is for headless runs: add --headless" in found.output


def test_a_report_that_cannot_be_written_at_the_end_is_a_fault(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The other faults are told too."""
    target = tmp_path / "folder" / "report.json"
    target.parent.mkdir()

    async def run(config: DemoConfig, *_: object) -> RunReport:
        remove()
        return RunReport(config.scenario, config.seed, None, None, None)

    remove = target.parent.rmdir
    monkeypatch.setattr(headless, "run_headless", run)
    monkeypatch.setattr("uvloop.run", asyncio.run)
    found = CliRunner().invoke(app, ["--headless", "--report", str(target)])
    assert found.exit_code == 1
    assert "the simulated world wrote no report" in found.output
    assert f"the report {target} cannot be written: No such file or directory" in found.output
