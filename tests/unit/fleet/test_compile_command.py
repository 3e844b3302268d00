"""``rce compile``: compiled once, found by all processes."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

from rce_fleet.compiled import copy_compiled
from rce_fleet.offline.compile_command import MODULES

ROOT = Path(__file__).parents[3]
COMPILE = """
import sys
from pathlib import Path
from rce_fleet import compiled
compiled.INSTALLED = Path(sys.argv[1])
from rce_fleet.navigation.planners import cost_to_go
made = compiled.compile_for_all() if sys.argv[2] == "install" else compiled.compile_kernels()
assert made
loops = [kernel.compile() for kernel in compiled._kernels]
print(sum(sum(loop.stats.cache_hits.values()) for loop in loops), len(loops))
"""


def test_every_module_with_loops_is_compiled() -> None:
    marks = re.compile(r"^(?:@|\w+ = )kernel\(", re.MULTILINE)
    found = {
        ".".join(path.relative_to(ROOT).with_suffix("").parts)
        for path in (ROOT / "rce_fleet").rglob("*.py")
        if path.name != "compiled.py" and marks.search(path.read_text())
    }
    program = "import sys, importlib; [importlib.import_module(m) for m in sys.argv[1:]]; print(*sys.modules)"
    argv = [sys.executable, "-c", program, *(name for part in MODULES for name in part)]
    imported = subprocess.run(argv, capture_output=True, text=True, check=True).stdout.split()
    assert found
    assert found <= set(imported)


def test_only_what_is_new_is_copied(tmp_path: Path) -> None:
    source, target = tmp_path / "source", tmp_path / "target"
    (source / "part").mkdir(parents=True)
    (target / "part").mkdir(parents=True)
    for name, ours, theirs in (("old.nbc", 100, 200), ("new.nbi", 200, 100), ("note.txt", 200, None)):
        for folder, time in ((source, ours), (target, theirs)):
            if time is not None:
                (folder / "part" / name).write_text(folder.name)
                os.utime(folder / "part" / name, (time, time))
    (source / "part" / "first.nbc").write_text("source")
    copy_compiled(source, target)
    copies = {path.name: path.read_text() for path in (target / "part").iterdir()}
    assert copies == {"old.nbc": "target", "new.nbi": "source", "first.nbc": "source"}


@pytest.mark.skipif(find_spec("numba") is None, reason="numba is missing (pip install rce[compiled])")
def test_a_process_with_its_own_folder_compiles_nothing(tmp_path: Path) -> None:
    def run(what: str, own: Path | None) -> tuple[int, int]:
        env = {
            key: value for key, value in os.environ.items() if key not in ("NUMBA_CACHE_DIR", "RCE_COMPILED")
        }
        if own is not None:
            env["NUMBA_CACHE_DIR"] = str(own)
        argv = [sys.executable, "-c", COMPILE, str(tmp_path / "installed"), what]
        hits, loops = subprocess.run(argv, capture_output=True, text=True, check=True, env=env).stdout.split()
        return int(hits), int(loops)

    assert run("install", None)[0] == 0
    hits, loops = run("use", tmp_path / "own")
    assert hits >= loops > 0
    assert run("use", None)[0] >= loops


def test_looking_for_numba_does_not_import_it() -> None:
    """A program that only asks whether loops can be compiled does not spend numba's memory."""
    look = "import sys; from rce_fleet.compiled import is_available as is_it; "
    look += "print(is_it(), 'numba' in sys.modules)"
    command = [sys.executable, "-c", look]
    told = subprocess.run(command, capture_output=True, text=True, check=True, cwd=ROOT)
    assert told.stdout.split() == [str(find_spec("numba") is not None), "False"]
