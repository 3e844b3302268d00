"""What a volume that is a folder holds; a node hides nothing from the measurement."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from rce.model import MEGABYTE, Volume
from rce_container.descent import MAX_DEPTH
from rce_container.exceptions import VolumeError
from rce_container.volumes import measuring
from rce_container.volumes.measuring import LEAST_PER_ENTRY, Measured, measure
from rce_container.volumes.store import VolumeStore

NOBODY = 65534
VOLUME = Volume(name="journal", path="/data", size=4 * MEGABYTE)


@pytest.fixture
def volume(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """An empty volume of an engine that is not root, in the working folder."""
    home = tmp_path / "home"
    home.mkdir()
    monkeypatch.chdir(home)
    own = os.geteuid()
    if own == 0:
        os.chown(home, NOBODY, NOBODY)
        os.seteuid(NOBODY)
    Path("volume").mkdir()
    try:
        yield Path("volume")
    finally:
        os.seteuid(own)


def test_empty_files_count(volume: Path) -> None:
    """Each takes an inode and a name."""
    for number in range(100):
        (volume / str(number)).touch()
    assert measure(volume) == Measured(100 * LEAST_PER_ENTRY)


@pytest.mark.parametrize("mode", [0, 0o311, 0o444])
@pytest.mark.parametrize("where", ["", "hidden", "hidden/inner"])
def test_unreadable_folders_are_measured(volume: Path, where: str, mode: int) -> None:
    """A folder that a node made unreadable is measured, and stays unreadable."""
    (volume / "hidden" / "inner").mkdir(parents=True)
    (volume / "hidden" / "inner" / "file").write_bytes(bytes(MEGABYTE))
    all_of_it = measure(volume)
    (volume / where).chmod(mode)
    assert measure(volume) == all_of_it
    assert all_of_it.used >= MEGABYTE
    assert (volume / where).stat().st_mode & 0o777 == mode
    (volume / where).chmod(0o700)


def test_a_folder_that_cannot_be_opened_is_a_fault(volume: Path) -> None:
    """A folder of another user counts as one that holds too much."""
    if os.getuid() != 0:
        pytest.skip("only root makes files of two users")
    os.seteuid(0)
    (volume / "hidden").mkdir(mode=0o700)
    os.seteuid(NOBODY)
    assert measure(volume).fault == "it has a folder that cannot be read"


def test_folders_too_deep_to_measure_are_a_fault(volume: Path) -> None:
    """Folders below the depth that can be measured are a fault, not empty."""
    at = os.open(volume, os.O_RDONLY)
    for _ in range(MAX_DEPTH + 1):
        os.mkdir("d", dir_fd=at)
        below = os.open("d", os.O_RDONLY, dir_fd=at)
        os.close(at)
        at = below
    os.close(at)
    assert measure(volume).fault == "it has folders that are nested more than 500 deep"


def test_too_many_files_are_a_fault(volume: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The measurement of a volume ends at its limit of files."""
    monkeypatch.setattr(measuring, "MAX_ENTRIES", 10)
    for number in range(10):
        (volume / str(number)).touch()
    assert measure(volume).fault == ""
    (volume / "more").touch()
    assert measure(volume).fault == "it has more than 10 files and folders"


def test_links_are_not_followed(volume: Path) -> None:
    """A link counts as one entry, wherever it leads."""
    Path("outside").mkdir()
    Path("outside", "file").write_bytes(bytes(MEGABYTE))
    (volume / "link").symlink_to(Path("outside").absolute())
    assert measure(volume) == Measured(LEAST_PER_ENTRY)


@pytest.fixture
def store(volume: Path) -> VolumeStore:
    return VolumeStore(volume, images=False)


def fault_of(store: VolumeStore, incarnation_id: str) -> str:
    """Start a container; return why it is refused."""
    store.claim("anna", incarnation_id, [VOLUME])
    try:
        store.check_room(incarnation_id)
    except VolumeError as error:
        return str(error)
    else:
        return ""
    finally:
        store.release(incarnation_id)


def test_containers_start_without_measuring(store: VolumeStore, monkeypatch: pytest.MonkeyPatch) -> None:
    """A folder is measured before a start only if it held too much when it was last measured."""
    measured: list[Path] = []

    def note(folder: Path) -> Measured:
        measured.append(folder)
        return measure(folder)

    monkeypatch.setattr(measuring, "measure", note)
    assert fault_of(store, "m1") == ""
    file = store.places.folder("anna/journal") / "file"
    file.write_bytes(os.urandom(5 * MEGABYTE))
    assert fault_of(store, "m2") == ""
    assert measured == []
    store.claim("anna", "m3", [VOLUME])
    ((over, text),) = store.measure({"m3": 0})
    assert over == "m3"
    assert "may hold 4 MiB" in text
    store.release("m3")
    assert fault_of(store, "m4") == text
    file.unlink()
    assert fault_of(store, "m5") == ""


def test_a_volume_that_cannot_be_measured_is_too_full(
    store: VolumeStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its user is told why; the volume can be removed and made again."""
    monkeypatch.setattr(measuring, "MAX_ENTRIES", 1)
    store.claim("anna", "m1", [VOLUME])
    folder = store.places.folder("anna/journal")
    for name in ("one", "two"):
        (folder / name).touch()
    ((over, text),) = store.measure({"m1": 0})
    assert over == "m1"
    assert "cannot be measured: it has more than 1 files" in text
    assert "rce volume remove journal" in text
    store.release("m1")
    assert fault_of(store, "m2") != ""
    store.doom("anna/journal")
    assert fault_of(store, "m3") == ""
