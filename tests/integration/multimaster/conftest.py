"""Masters that find each other."""

from __future__ import annotations

import pytest
from support.multimaster import Neighbourhood


@pytest.fixture
def neighbourhood() -> Neighbourhood:
    return Neighbourhood()
