from __future__ import annotations

import asyncio

import pytest

from rce_master.exceptions import BusyError, TooMuchError
from rce_master.packages.uploads import FIRST_S, MAX_UPLOADS, Upload, Uploads


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


class Site:
    def __init__(self, group: asyncio.TaskGroup) -> None:
        self.clock = Clock()
        self.uploads = Uploads(self.clock)
        self.group = group
        self.current: dict[str, Upload] = {}
        self.ended: dict[str, str] = {}

    async def begin(self, user: str) -> asyncio.Task[None]:
        task = self.group.create_task(self._run(user))
        await asyncio.sleep(0)
        return task

    async def _run(self, user: str) -> None:
        try:
            async with self.uploads.one(user) as upload:
                self.current[user] = upload
                await asyncio.Event().wait()
        except (BusyError, TooMuchError) as error:
            self.ended[user] = str(error)


async def settle() -> None:
    for _ in range(5):
        await asyncio.sleep(0.001)


async def test_the_slowest_upload_gives_way_when_there_are_too_many() -> None:
    async with asyncio.TaskGroup() as group:
        site = Site(group)
        tasks = [await site.begin(f"slow{number}") for number in range(MAX_UPLOADS)]
        for upload in site.current.values():
            upload.received = 1_000_000
        site.current["slow5"].received = 10
        tasks.append(await site.begin("early"))
        assert "too many packages" in site.ended["early"]
        site.clock.now = FIRST_S
        tasks.append(await site.begin("new"))
        await settle()
        assert list(site.ended) == ["early", "slow5"]
        assert "gave way" in site.ended["slow5"]
        assert site.current["new"].begun == FIRST_S
        for task in tasks:
            task.cancel()
    assert not site.uploads._uploads


async def test_a_user_sends_one_package_at_a_time() -> None:
    async with asyncio.TaskGroup() as group:
        site = Site(group)
        task = await site.begin("anna")
        with pytest.raises(TooMuchError, match="another package just now"):
            async with site.uploads.one("anna"):
                pass
        other = await site.begin("bert")
        task.cancel()
        other.cancel()
        await settle()
        last = await site.begin("anna")
        assert not site.ended
        last.cancel()
