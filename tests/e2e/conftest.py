"""A folder with a short path; an engine with TLS, which the tests of a module share."""

from __future__ import annotations

import tempfile
from collections.abc import AsyncIterator, Iterator
from pathlib import Path

import pytest
import pytest_asyncio
from support.engine import engine_folder
from support.short_folders import PREFIX, TMP
from support.tls_engine import World


@pytest.fixture
def folder() -> Iterator[Path]:
    """For an engine that leaves nothing, and for sockets, whose paths have at most 107 bytes."""
    with engine_folder() as path:
        yield path


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def shared_engine(request: pytest.FixtureRequest) -> AsyncIterator[World]:
    public = getattr(request.module, "PUBLIC_CERTIFICATE", False)
    with tempfile.TemporaryDirectory(prefix=PREFIX, dir=TMP) as folder:
        found = World(Path(folder), public=public)
        await found.start()
        try:
            yield found
            assert "Traceback" not in found.output()
        finally:
            await found.stop()


@pytest.fixture
def world(shared_engine: World) -> World:
    return shared_engine
