"""The ``rce`` program: commands are plugged in, and one that cannot be loaded harms no other."""

from __future__ import annotations

import sys
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest
from typer.testing import CliRunner

from rce.cli.main import GROUP, INTERRUPTED, build_app, main

WORKS = 'def command():\n    """Do it."""\n    print("done")\n'


@pytest.fixture
def points(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[EntryPoint]:
    (tmp_path / "plugged_good.py").write_text(WORKS)
    (tmp_path / "plugged_needy.py").write_text("import package_of_an_extra\n" + WORKS)
    (tmp_path / "plugged_broken.py").write_text("import rce.no_such_module\n" + WORKS)
    monkeypatch.syspath_prepend(str(tmp_path))
    for name in ("good", "needy", "broken"):
        monkeypatch.delitem(sys.modules, f"plugged_{name}", raising=False)
    return [EntryPoint(name, f"plugged_{name}:command", GROUP) for name in ("good", "needy", "broken")]


def test_a_command_whose_packages_are_missing_says_so(points: list[EntryPoint]) -> None:
    app = build_app(points[:2])
    assert CliRunner().invoke(app, ["good"]).output == "done\n"
    result = CliRunner().invoke(app, ["needy", "--option", "7"])
    assert result.exit_code == 1
    assert "package_of_an_extra is missing" in result.output


def test_a_broken_command_is_no_missing_package(points: list[EntryPoint]) -> None:
    with pytest.raises(ModuleNotFoundError):
        build_app(points)


def test_ctrl_c_while_a_command_is_imported_ends_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "plugged_slow.py").write_text("raise KeyboardInterrupt\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    point = EntryPoint("slow", "plugged_slow:command", GROUP)
    monkeypatch.setattr(sys.modules["rce.cli.main"], "entry_points", lambda group: [point])
    monkeypatch.setattr(sys, "argv", ["rce", "slow"])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == INTERRUPTED
