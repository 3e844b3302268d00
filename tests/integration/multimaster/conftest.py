"""Masters that find each other."""

from __future__ import annotations

import pytest
from support.multimaster import DiscoveryNetwork


@pytest.fixture
def network() -> DiscoveryNetwork:
    return DiscoveryNetwork()
