"""Parameters: what is set and deleted, and what strings become."""

from __future__ import annotations

from pathlib import Path

import pytest

from rce.model.specs import ParameterSpec
from rce.ros.packages import PackageIndex
from rce_container.environment.parameters import difference, evaluate_all

ENVIRON = {"HOME": "/home/rce"}


@pytest.fixture
def packages(tmp_path: Path) -> PackageIndex:
    (tmp_path / "maps").mkdir()
    (tmp_path / "maps" / "package.yaml").write_text("name: maps\n")
    return PackageIndex([tmp_path])


def test_only_differences_are_done() -> None:
    change = difference({"/a": 1, "/b": "x", "/c": [1]}, {"/a": 1, "/b": "y", "/d": 2})
    assert change.delete == ["/c"]
    assert change.set == {"/b": "y", "/d": 2}


@pytest.mark.parametrize(("now", "then"), [(1, True), (1, 1.0), ([1], [True]), ([1], [1, 2])])
def test_another_type_is_a_difference(now: object, then: object) -> None:
    assert difference({"/a": now}, {"/a": then}).set == {"/a": then}  # type: ignore[dict-item]  # parameters of each type
    assert not difference({"/a": now}, {"/a": now}).set  # type: ignore[dict-item]  # parameters of each type


def test_strings_are_substituted(packages: PackageIndex, tmp_path: Path) -> None:
    values, faults = evaluate_all(
        [
            ParameterSpec(name="map", value="$(find maps)/a.pgm"),
            ParameterSpec(name="ns/list", value=["$(env HOME)", 1]),
            ParameterSpec(name="number", value=2.5),
        ],
        packages,
        ENVIRON,
    )
    assert not faults
    assert values == {"/map": f"{tmp_path}/maps/a.pgm", "/ns/list": ["/home/rce", 1], "/number": 2.5}


def test_a_bad_one_leaves_the_others_alone(packages: PackageIndex) -> None:
    values, faults = evaluate_all(
        [
            ParameterSpec(name="bad", value="$(find nothing)"),
            ParameterSpec(name="good", value=1),
            ParameterSpec(name="not a name", value=1),
        ],
        packages,
        ENVIRON,
    )
    assert values == {"/good": 1}
    assert "nothing" in str(faults[0])
    assert "not a ROS name" in str(faults[1])
