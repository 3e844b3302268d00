"""People who run the engine on this machine: root, and a normal user with a Python of their own."""

from __future__ import annotations

import contextlib
import json
import os
import pwd
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

from support.short_folders import make_folder

ROOT = Path(__file__).parents[2]
USER = "rce-test"
SYSTEM_PYTHON = "/usr/bin/python3"
_IMPORTED = ("rce", "rce_container", "rce_fleet")
SECRET = "what-only-the-engine-of-the-tests-may-know"


class Person:
    """Who runs the engine: how its programs are started, and where it may write."""

    runtime = "namespace"

    def __init__(self, name: str, prefix: Sequence[str], python: str, source: Path, folder: Path) -> None:
        self.name = name
        self.uid = pwd.getpwnam(name).pw_uid
        self.folder = folder
        self._prefix = prefix
        self._python = python
        self._source = source

    def run(self, *words: str, module: str = "support.sandbox") -> dict[str, Any]:
        """Run a module with a fresh folder and the runtime before its arguments; returns what it found."""
        env = {
            "PATH": "/usr/local/bin:/usr/bin:/bin",
            "PYTHONPATH": f"{self._source}:{self._source / 'tests'}",
            "XDG_RUNTIME_DIR": str(self.folder),
            "RCE_SECRET": SECRET,
        }
        work = tempfile.mkdtemp(dir=self.folder)
        argv = [*self._prefix, self._python, "-m", module, f"{work}/m", self.runtime, *words]
        os.chown(work, self.uid, self.uid)
        done = subprocess.run(
            argv, env=env, cwd="/", capture_output=True, text=True, timeout=500, check=False
        )
        assert done.returncode == 0, done.stderr
        found = json.loads(done.stdout.splitlines()[-1])
        assert isinstance(found, dict)
        return found


@contextlib.contextmanager
def root() -> Iterator[Person]:
    """Root, with the engine where it is."""
    if os.geteuid() != 0:
        pytest.skip("needs root")
    folder = make_folder()
    yield Person("root", (), sys.executable, ROOT, folder)
    shutil.rmtree(folder)


@contextlib.contextmanager
def normal() -> Iterator[Person]:
    """A user with a Python of their own: the engine's may lie where nobody else can read it."""
    if os.geteuid() != 0:
        name = pwd.getpwuid(os.geteuid()).pw_name
        folder = make_folder()
        yield Person(name, (), sys.executable, ROOT, folder)
        shutil.rmtree(folder)
        return
    wanted = f"{sys.version_info.major}.{sys.version_info.minor}"
    version = "import sys; print('%d.%d' % sys.version_info[:2])"
    found = subprocess.run([SYSTEM_PYTHON, "-c", version], capture_output=True, text=True, check=False)
    if found.stdout.strip() != wanted:
        pytest.skip(
            f"{SYSTEM_PYTHON} is not Python {wanted}, so it cannot use the packages that are installed"
        )
    subprocess.run(["useradd", "--system", "--no-create-home", USER], check=False, capture_output=True)
    folder = make_folder()
    folder.chmod(0o755)
    python = _copy_engine(folder)
    home = folder / "home"
    home.mkdir()
    person = pwd.getpwnam(USER)
    os.chown(home, person.pw_uid, person.pw_gid)
    prefix = ("setpriv", f"--reuid={person.pw_uid}", f"--regid={person.pw_gid}", "--clear-groups")
    yield Person(USER, prefix, python, folder / "source", home)
    shutil.rmtree(folder)
    subprocess.run(["userdel", USER], check=False, capture_output=True)


def _copy_engine(folder: Path) -> str:
    """Copy the engine with all that it imports; returns a Python that finds it."""
    subprocess.run([SYSTEM_PYTHON, "-m", "venv", "--without-pip", folder / "venv"], check=True)
    (site,) = (folder / "venv" / "lib").glob("python*/site-packages")
    source = next(path for path in map(Path, sys.path) if path.name == "site-packages" and path.is_dir())
    site.rmdir()
    if subprocess.run(["cp", "-al", source, site], capture_output=True, check=False).returncode:
        shutil.rmtree(site, ignore_errors=True)
        subprocess.run(["cp", "-a", source, site], check=True)
    for name in (*_IMPORTED, "examples", "configs", "tests/support"):
        shutil.copytree(ROOT / name, folder / "source" / name)  # with bytecode
    python = str(folder / "venv" / "bin" / "python")
    # They cannot keep bytecode there: what has none now would be compiled by each of their programs.
    imported = [folder / "source" / name for name in _IMPORTED]
    subprocess.run([python, "-m", "compileall", "-q", *imported], check=True)
    return python
