"""Package folders that a container's user may not read are named before anybody misses a package."""

from __future__ import annotations

from pathlib import Path

import pytest

from rce_container.folder import Record
from rce_container.runtimes.namespace import NamespaceRuntime
from rce_container.runtimes.process import ProcessRuntime


@pytest.fixture
def runtime(monkeypatch: pytest.MonkeyPatch) -> NamespaceRuntime:
    runtime = NamespaceRuntime()
    monkeypatch.setattr(runtime, "_root", True)
    return runtime


def test_a_private_folder_is_named(
    runtime: NamespaceRuntime, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folders = [tmp_path / name for name in ("open", "closed", "missing")]
    for folder, mode in zip(folders, (0o755, 0o700), strict=False):
        folder.mkdir()
        folder.chmod(mode)
    assert runtime.review(folders[:1]) == ""
    text = runtime.review(folders)
    assert f"containers cannot read {folders[1]}:" in text
    assert "chmod" in text
    monkeypatch.setattr(runtime, "_root", False)
    assert runtime.review(folders) == ""
    assert ProcessRuntime().review(folders) == ""


def test_a_container_without_an_environment_was_never_born(runtime: NamespaceRuntime) -> None:
    record = Record(id="user/box", incarnation_id="0" * 12, runtime="namespace", pid=1, start=1)
    assert runtime.is_starting(record)
    assert not ProcessRuntime().is_starting(record)
