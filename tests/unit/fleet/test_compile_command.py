"""``rce compile``: compiled once, found by all processes."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import pytest

from rce_fleet.compiled import copy_compiled
from rce_fleet.offline.compile_command import MODULES

ROOT = Path(__file__).parents[3]
LOOP = """
from rce_fleet.compiled import kernel
from the_helper import plus

@kernel("int64(int64)", numpy=lambda value: -1)
def twice_plus(value):
    return plus(plus(value))
"""
HELPER = """
from rce_fleet.compiled import helper

STEP = {step}

@helper
def plus(value):
    return value {sign} STEP
"""
COMPILE = """
import sys
from pathlib import Path
from rce_fleet import compiled
compiled.INSTALLED = Path(sys.argv[1])
from the_loop import twice_plus
made = compiled.compile_for_all() if sys.argv[2] == "install" else compiled.compile_kernels()
assert made
loop = twice_plus.compile()
print(sum(loop.stats.cache_hits.values()), twice_plus(10))
"""

LOAD = """
import sys
from pathlib import Path
from rce_fleet import compiled
compiled.INSTALLED = Path(sys.argv[1])
from the_loop import twice_plus
print(compiled.load_kernels([twice_plus]))
"""


@dataclass
class Cache:
    """A loop and its helper in two files, and the folders that they are compiled into."""

    folder: Path

    def write_helper(self, *, step: int, sign: str = "+") -> None:
        (self.folder / "the_helper.py").write_text(HELPER.format(step=step, sign=sign))

    def run(self, what: str, own: Path | None = None) -> tuple[int, int]:
        """Compile or use the loop in a process; return how often the cache had it, and what it answers."""
        env = {
            key: value for key, value in os.environ.items() if key not in ("NUMBA_CACHE_DIR", "RCE_COMPILED")
        }
        env |= {"PYTHONPATH": str(self.folder), "PYTHONDONTWRITEBYTECODE": "1"}
        if own is not None:
            env["NUMBA_CACHE_DIR"] = str(own)
        argv = [sys.executable, "-c", COMPILE, str(self.folder / "installed"), what]
        told = subprocess.run(argv, capture_output=True, text=True, check=True, env=env, cwd=ROOT)
        hits, answer = told.stdout.split()
        return int(hits), int(answer)

    def load(self, own: Path) -> bool:
        """Return whether a process found the loop in a cache."""
        env = {key: value for key, value in os.environ.items() if key != "RCE_COMPILED"}
        env |= {"PYTHONPATH": str(self.folder), "PYTHONDONTWRITEBYTECODE": "1", "NUMBA_CACHE_DIR": str(own)}
        argv = [sys.executable, "-c", LOAD, str(self.folder / "installed")]
        told = subprocess.run(argv, capture_output=True, text=True, check=True, env=env, cwd=ROOT)
        return told.stdout.split() == ["True"]


@pytest.fixture
def cache(tmp_path: Path) -> Cache:
    if find_spec("numba") is None:
        pytest.skip("numba is missing (pip install rce[compiled])")
    made = Cache(tmp_path)
    (tmp_path / "the_loop.py").write_text(LOOP)
    made.write_helper(step=1)
    return made


@pytest.mark.slow
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


@pytest.mark.slow
def test_a_process_with_its_own_folder_compiles_nothing(cache: Cache, tmp_path: Path) -> None:
    assert cache.run("install") == (0, 12)
    assert cache.run("use", tmp_path / "own") == (1, 12)
    assert cache.run("use") == (1, 12)


@pytest.mark.slow
def test_loading_says_whether_the_cache_has_the_loops(cache: Cache, tmp_path: Path) -> None:
    assert not cache.load(tmp_path / "empty")
    assert cache.run("use", tmp_path / "own") == (0, 12)
    assert cache.load(tmp_path / "own")
    assert cache.run("install") == (0, 12)
    assert cache.load(tmp_path / "another"), "as a container does with what rce compile made"


@pytest.mark.slow
def test_a_changed_helper_is_compiled_anew(cache: Cache) -> None:
    """numba itself looks at the file of the loop only."""
    assert cache.run("install") == (0, 12)
    cache.write_helper(step=2)
    assert cache.run("use") == (0, 14)
    cache.write_helper(step=2, sign="-")
    assert cache.run("use") == (0, 6)


def test_looking_for_numba_does_not_import_it() -> None:
    """A program that only asks whether loops can be compiled does not spend numba's memory."""
    look = "import sys; from rce_fleet.compiled import is_available as is_it; "
    look += "print(is_it(), 'numba' in sys.modules)"
    command = [sys.executable, "-c", look]
    told = subprocess.run(command, capture_output=True, text=True, check=True, cwd=ROOT)
    assert told.stdout.split() == [str(find_spec("numba") is not None), "False"]
