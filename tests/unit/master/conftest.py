from __future__ import annotations

from collections.abc import AsyncIterator

import pytest
from support.master_cloud import Cloud, FragileStore, running
from support.master_world import World


@pytest.fixture
def world() -> World:
    return World()


@pytest.fixture
async def cloud() -> AsyncIterator[Cloud]:
    async with running(FragileStore()) as made:
        yield made
