"""The volumes of a machine: what is left after faults."""

from __future__ import annotations

from pathlib import Path

import pytest

from rce.model import MEGABYTE
from rce_container.exceptions import VolumeError
from rce_container.volumes import images
from rce_container.volumes.places import VolumePlaces


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
