"""A machine for containers, for every runtime."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from support.containers import RUNTIMES, Machine
from support.short_folders import make_folder


@pytest.fixture
def folder() -> Iterator[Path]:
    path = make_folder()
    yield path
    shutil.rmtree(path)


@pytest.fixture(params=RUNTIMES)
def machine(request: pytest.FixtureRequest, folder: Path) -> Iterator[Machine]:
    machine = Machine(folder, request.param)
    yield machine
    machine.tidy()


@pytest.fixture
def pair(folder: Path) -> Iterator[tuple[Machine, Machine]]:
    """Two machines whose volumes are folders."""
    machines = (Machine(folder / "a", "process"), Machine(folder / "b", "process"))
    yield machines
    for machine in machines:
        machine.tidy()
