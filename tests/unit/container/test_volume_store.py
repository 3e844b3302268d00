"""The volumes of a machine: what is left after faults, and what threads and the event loop share."""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from rce.model import MEGABYTE
from rce_container.exceptions import VolumeError
from rce_container.volumes import images
from rce_container.volumes.places import VolumePlaces
from rce_container.volumes.store import VolumeStore


def test_a_volume_that_cannot_be_opened_takes_no_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The master asks for it every 30 s, and an image has its full size at once."""
    monkeypatch.setattr(images, "make", lambda image, size: image.write_bytes(bytes(size)))
    places = VolumePlaces(tmp_path / "volumes", images=True)
    for _ in range(2):
        with pytest.raises(VolumeError, match="cannot be mounted"):  # no file system is in it
            places.make_new(MEGABYTE)
    assert [path for path in (tmp_path / "volumes" / ".scratch").rglob("*") if path.is_file()] == []


@pytest.fixture
def often_switched() -> Iterator[None]:
    """Threads take turns as often as they can."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    yield
    sys.setswitchinterval(before)


@pytest.mark.slow
@pytest.mark.usefixtures("often_switched")
def test_volumes_come_and_go_while_they_are_measured(tmp_path: Path) -> None:
    """A thread measures; the event loop gives volumes to containers meanwhile.

    No file system is in the images, as after a power failure; measuring continues.
    """
    store = VolumeStore(tmp_path, images=True)
    (tmp_path / "anna").mkdir()
    for number in range(20):
        (tmp_path / "anna" / f"v{number}.img").touch()
    is_done = threading.Event()
    faults: list[Exception] = []

    def measure() -> None:
        try:
            while not is_done.is_set():
                store.measure({})
        except Exception as error:  # noqa: BLE001 - reported by the test
            faults.append(error)

    thread = threading.Thread(target=measure)
    thread.start()
    holders = [store.hold(f"anna/held{number}") for number in range(1000)]
    for holder in holders:
        store.release(holder)
    is_done.set()
    thread.join()
    assert faults == []


def test_files_beside_volumes_are_passed_over(tmp_path: Path) -> None:
    """Operators copy volumes to names beside them, and rsync writes to a hidden name first."""
    store = VolumeStore(tmp_path, images=True)
    (tmp_path / "anna" / "folder").mkdir(parents=True)
    (tmp_path / "anna" / "folder" / "file").write_bytes(bytes(5))
    (tmp_path / "notes").touch()  # the name of a user, but not a folder
    for name in ("map.img", "map.img.bak", "map-old.img", ".map.img.aB3dEf", "words.txt"):
        (tmp_path / "anna" / name).touch()
    assert store.places.existing() == ["anna/folder", "anna/map"]
    assert store.measure({}) == []
    assert list(store.used) == ["anna/folder"], "map.img holds no file system"


def test_an_invalid_name_does_not_end_the_measuring(tmp_path: Path) -> None:
    store = VolumeStore(tmp_path, images=True)
    store.hold("anna/map-old")
    assert store.measure({}) == []


def test_a_placement_is_on_the_disk_before_it_counts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """After a loss of power, an empty marker would say that the volume's files are lost."""
    synced: list[int] = []
    late: list[str] = []
    sync, replace = os.fsync, Path.replace

    def noted(fd: int) -> None:
        synced.append(os.fstat(fd).st_ino)
        sync(fd)

    def checked(path: Path, target: Path) -> Path:
        if path.stat().st_ino not in synced:
            late.append(path.name)
        synced.clear()
        return replace(path, target)

    monkeypatch.setattr(os, "fsync", noted)
    monkeypatch.setattr(Path, "replace", checked)
    places = VolumePlaces(tmp_path / "volumes", images=False)
    places.make_folder(tmp_path / "volumes" / "anna" / "map")
    places.note_placement("anna/map", 7)
    assert places.placement("anna/map") == 7
    assert late == []
    assert synced == [(tmp_path / "volumes" / ".placements" / "anna").stat().st_ino]
