"""Volumes as users write them: sizes, and paths that must not hide what a container needs."""

from __future__ import annotations

from typing import Any

import pytest

from rce.model import MEGABYTE, CreateContainer, SpecError, Volume
from rce.protocol.requests import SPELLING


def volume(name: str = "journal", path: str = "/data", size: Any = "64M") -> dict[str, Any]:
    return {"name": name, "path": path, "size": size}


def read(*volumes: dict[str, Any]) -> tuple[Volume, ...]:
    data = {"containerTag": "c", "containerData": {"volumes": list(volumes)}}
    return SPELLING.read(CreateContainer, data).resources.volumes


def fault(*volumes: dict[str, Any]) -> str:
    with pytest.raises(SpecError) as caught:
        read(*volumes)
    return str(caught.value)


@pytest.mark.parametrize("path", ["/data", "/home/rce/journal", "/var/lib/fleet", "/srv/a.b/c-d_e+f@g"])
def test_a_volume_is_read(path: str) -> None:
    (found,) = read(volume(path=path, size=64))
    assert found == Volume(name="journal", path=path, size=64 * MEGABYTE)
    assert found.variable == "RCE_VOLUME_JOURNAL"


@pytest.mark.parametrize(
    "path",
    [
        *("/", "", "data", "/data/", "//data", "/data/../etc", "/./data", "/..", "/a/..", "/da ta", "/a:b"),
        *("/proc", "/proc/sys", "/etc", "/etc/passwd", "/sys", "/dev/shm", "/usr/local/bin", "/lib/x"),
        *("/opt", "/opt/rce", "/var", "/var/log/rce", "/home", "/home/rce", "/tmp/x", "/run/x", "/da\nta"),
        "/" + "x" * 255,
    ],
)
def test_a_path_that_hides_or_leaves_is_refused(path: str) -> None:
    text = fault(volume(path=path))
    assert text.startswith("containerData.volumes: [0].path must"), text


@pytest.mark.parametrize("name", ["", "..", "../x", "a/b", "1st", "a b", "a.b"])
def test_names_are_plain(name: str) -> None:
    assert "containerData.volumes[0].name" in fault(volume(name=name))


@pytest.mark.parametrize("size", [0, 3, "1K", -5, "17T", "much"])
def test_sizes_have_bounds(size: Any) -> None:
    assert "[0].size must be" in fault(volume(size=size))


def test_two_volumes_do_not_overlap() -> None:
    assert "inside one another" in fault(volume(), volume("other", "/data/inside"))
    assert "inside one another" in fault(volume(path="/data/deep"), volume("other"))
    assert "is mounted already, at /data" in fault(volume(), volume(path="/more"))
    assert "only in its case" in fault(volume(), volume("Journal", "/more"))
    assert len(read(volume(), volume("other", "/data2"))) == 2


def test_unknown_and_missing_keys_are_named() -> None:
    assert "volumes[0]" in fault({**volume(), "mode": "ro"})
    assert "containerData.volumes[0].path: is missing" in fault({"name": "a", "size": 64})


def test_there_are_at_most_so_many() -> None:
    many = [volume(f"v{number}", f"/data/v{number}") for number in range(17)]
    assert "at most 16 volumes, not 17" in fault(*many)
