"""What killed test runs left is removed by a later run."""

from __future__ import annotations

import os
import time
from pathlib import Path

from support.short_folders import OLD_S, PREFIX, RUN_PREFIX, sweep_old_folders


def test_only_old_folders_of_tests_are_removed(tmp_path: Path) -> None:
    old, young = time.time() - OLD_S - 60, time.time() - OLD_S + 60
    for name, changed in (
        (f"{PREFIX}old", old),
        (f"{RUN_PREFIX}old", old),
        (f"{PREFIX}young", young),
        ("rce-0", old),
    ):
        (tmp_path / name / "deep").mkdir(parents=True)
        (tmp_path / name / "deep" / "file").write_text("kept by a test that failed")
        os.utime(tmp_path / name, (changed, changed))
    sweep_old_folders(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {f"{PREFIX}young", "rce-0"}
