"""A station for ``rce fleet``, and a file of logins that is empty."""

from __future__ import annotations

from collections.abc import AsyncIterator
from pathlib import Path

import pytest
from support.commanded_station import Station, served

from rce_fleet.cli.access import TOKEN_VARIABLE
from rce_master.cli.credentials import FILE_VARIABLE


@pytest.fixture
def station() -> Station:
    return Station()


@pytest.fixture
async def url(station: Station) -> AsyncIterator[str]:
    async with served(station.answer) as address:
        yield address


@pytest.fixture(autouse=True)
def login(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    file = tmp_path / "login.json"
    monkeypatch.setenv(FILE_VARIABLE, str(file))
    monkeypatch.delenv(TOKEN_VARIABLE, raising=False)
    monkeypatch.delenv("RCE_STATION", raising=False)
    return file
