"""``rce --help`` lists all commands without importing them."""

from __future__ import annotations

import re
import subprocess
import sys
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path

import pytest
from typer.testing import CliRunner

from rce.cli.main import GROUP, build_app
from rce.cli.summaries import summary_of

OPTIONS = Path(__file__).parents[3] / "docs" / "reference" / "options.md"
POINTS = sorted(entry_points(group=GROUP), key=lambda point: point.name)
LIST = """
import sys
from rce.cli.main import main
sys.argv = ["rce", "--help"]
try:
    main()
finally:
    print(sorted({name.partition(".")[0] for name in sys.modules if name.startswith("rce_")}))
"""
WRITTEN = """
def command(word: str) -> None:
    '''Do it.'''
    print("does", word)
"""
MADE = WRITTEN.replace("'''Do it.'''", "pass") + "\n\ncommand.__doc__ = 'Do it.'\n"


@pytest.mark.parametrize("point", POINTS, ids=[point.name for point in POINTS])
def test_line_is_that_of_the_reference(point: EntryPoint) -> None:
    """The page is made from the imported commands."""
    found = re.search(rf"^## `rce {point.name}`\n\n(.+)$", OPTIONS.read_text("utf-8"), re.MULTILINE)
    assert found is not None
    summary = summary_of(point.module, point.attr)
    assert summary is not None
    assert " ".join(summary.partition("\n\n")[0].split()) == found[1]


@pytest.mark.slow
def test_no_command_is_imported() -> None:
    done = subprocess.run([sys.executable, "-c", LIST], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"
    assert all(re.search(rf"^\W*{point.name} ", done.stdout, re.MULTILINE) for point in POINTS)


@pytest.mark.parametrize("source", [WRITTEN, MADE], ids=["in the source", "made when it is imported"])
def test_listed_command_runs(source: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A command that comes after ``--`` is one of the list."""
    (tmp_path / "listed_command.py").write_text(source)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "listed_command", raising=False)
    app = build_app([EntryPoint("do", "listed_command:command", GROUP)], listing=True)
    assert "Do it." in CliRunner().invoke(app, ["--help"]).output
    assert CliRunner().invoke(app, ["do", "this"]).output == "does this\n"
    assert "word" in CliRunner().invoke(app, ["do", "--help"]).output


def test_module_without_a_source_says_nothing() -> None:
    assert summary_of("no_such_package.commands", "command") is None
    assert summary_of("rce.cli.main", "no_such_name") is None
