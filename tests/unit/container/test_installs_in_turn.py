"""Requirements that several users ask for are installed once, and take the place of one."""

from __future__ import annotations

import asyncio
import sys
from typing import TYPE_CHECKING

import pytest

from rce_container.packages import requirements
from rce_container.packages.exceptions import RequirementsTroubleError
from rce_container.packages.requirements import INSTALLS_AT_ONCE, Installer, InstallerSettings

if TYPE_CHECKING:
    from pathlib import Path


class Pip:
    """Builds in place of pip: what is called slow, when it is told to."""

    def __init__(self) -> None:
        self.built: list[str] = []
        self.begun = asyncio.Event()
        self.go = asyncio.Event()
        self.faults = 0

    async def build(self, path: Path, text: str, python: str) -> None:
        self.built.append(text.strip())
        if text.startswith("slow"):
            self.begun.set()
            await self.go.wait()
        if self.faults:
            self.faults -= 1
            raise RequirementsTroubleError("pip could not install it")
        path.mkdir(parents=True)


@pytest.fixture
def pip() -> Pip:
    return Pip()


@pytest.fixture
def installer(pip: Pip, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Installer:
    async def tag(_: str) -> str:
        return "tag"

    monkeypatch.setattr(requirements, "_tag_of", tag)
    monkeypatch.setattr(requirements, "_python_of", lambda _: sys.executable)
    made = Installer(tmp_path / "requirements", InstallerSettings(), {})
    monkeypatch.setattr(made, "_build", pip.build)
    for name in ("slow", "quick"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "requirements.txt").write_text(f"{name}\n")
    return made


async def test_users_with_one_requirement_hold_one_place(
    installer: Installer, pip: Pip, tmp_path: Path
) -> None:
    """As a class that gets the same task: others are not held up by those who wait for one build."""
    async with asyncio.timeout(60), asyncio.TaskGroup() as group:
        first = group.create_task(installer.install("user0", tmp_path / "slow"))
        await pip.begun.wait()
        others = [
            group.create_task(installer.install(f"user{number}", tmp_path / "slow"))
            for number in range(1, INSTALLS_AT_ONCE)
        ]
        while installer._locks._busy.total() < INSTALLS_AT_ONCE:
            await asyncio.sleep(0.01)
        await installer.install("anna", tmp_path / "quick")
        pip.go.set()
    assert pip.built == ["slow", "quick"]
    assert {one.result() for one in others} == {first.result()}


async def test_a_build_that_failed_is_tried_by_those_who_waited(
    installer: Installer, pip: Pip, tmp_path: Path
) -> None:
    pip.faults = 1
    async with asyncio.timeout(60):
        installs = [
            asyncio.create_task(installer.install(f"user{number}", tmp_path / "slow")) for number in range(3)
        ]
        await pip.begun.wait()
        pip.go.set()
        results = await asyncio.gather(*installs, return_exceptions=True)
    assert pip.built == ["slow", "slow"]
    assert sum(isinstance(one, RequirementsTroubleError) for one in results) == 1
