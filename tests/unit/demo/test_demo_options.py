"""Options of ``rce demo`` that are refused before anything is started."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

from rce_fleet.demo import headless
from rce_fleet.demo.command import demo
from rce_fleet.demo.config import DemoConfig
from rce_fleet.demo.headless import RunReport

app = typer.Typer()
app.command()(demo)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--report", "no-such-folder/report.json"), "is not in a folder that exists"),
        (("--report", "."), "is a folder"),
        (("--duration", "60", "--timeout", "60"), "--timeout 60 ends the run before its --duration of 60 s"),
        (("--duration", "60", "--mode", "single"), "use --mode cloud"),
    ],
)
def test_headless_options_that_cannot_be_met_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, options: tuple[str, ...], words: str
) -> None:
    """A report that could not be written was a traceback after the run, and its numbers were lost."""
    monkeypatch.chdir(tmp_path)
    found = CliRunner().invoke(app, ["--headless", *options])
    assert (found.exit_code, words in found.output) == (1, True), found.output


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
