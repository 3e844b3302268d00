"""Which scans count as whole."""

from __future__ import annotations

from math import pi

import pytest

from rce_fleet.navigation.scans import fault_of_scan

BEAMS = 720
STEP = 2 * pi / BEAMS


@pytest.mark.parametrize("beams_more", [-14, -3, 0, 3, 14])
def test_some_beams_more_or_fewer_are_tolerated(beams_more: int) -> None:
    """As by localization, with which costmaps and the safety stage must agree."""
    assert fault_of_scan(BEAMS + beams_more, (-pi, pi - STEP, STEP), (0.1, 6.0)) == ""


@pytest.mark.parametrize(("count", "step"), [(700, STEP), (740, STEP), (BEAMS, -STEP), (BEAMS, 1e-320)])
def test_other_angles_are_a_fault(count: int, step: float) -> None:
    assert "expected" in fault_of_scan(count, (-pi, pi - STEP, step), (0.1, 6.0))
