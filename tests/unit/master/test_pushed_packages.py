"""A package that is pushed while the master has much to do."""

from __future__ import annotations

import asyncio
import hashlib
import io
from collections.abc import AsyncIterator
from contextlib import suppress
from pathlib import Path

from support.master_cloud import Cloud

from rce.packages.folder import look_into
from rce.packages.signing import SigningKey, statement
from rce_master.packages.contents import ContentStore
from rce_master.packages.keeper import ContentKeeper
from rce_master.packages.service import PackageService, PushRequest
from rce_master.state import commands
from rce_master.state.user_records import PackageKey


def archive_of(folder: Path) -> bytes:
    folder.mkdir()
    (folder / "package.yaml").write_text("name: nav\nversion: '1.0'\n")
    archive = io.BytesIO()
    look_into(folder).pack(archive)
    return archive.getvalue()


async def test_a_push_that_is_cancelled_keeps_its_archive(cloud: Cloud, tmp_path: Path) -> None:
    """The state has the version all the same: its command waited for its turn already."""
    archive, key = archive_of(tmp_path / "nav"), SigningKey.generate()
    sha256 = hashlib.sha256(archive).hexdigest()
    known = PackageKey(user="anna", key=key.public, label="", created=0.0)
    state_service = cloud.state_service
    await state_service.submit(commands.AddPackageKey(key=known))
    keeper = ContentKeeper(state_service, ContentStore(tmp_path / "packages", noun="package"))

    async def pieces() -> AsyncIterator[bytes]:
        yield archive

    signature = key.sign(statement("anna", "nav", "1.0", sha256))
    request = PushRequest(user="anna", name="nav", version="1.0", key=key.public, signature=signature)
    cloud.store.free.clear()
    before = await state_service.enqueue([commands.CreateContainer(user="anna", tag="c")])
    async with asyncio.timeout(60):
        while state_service._jobs.qsize():
            await asyncio.sleep(0)
        service = PackageService(state_service, keeper)
        pushing = asyncio.create_task(service.push(request, len(archive), pieces()))
        while not state_service._jobs.qsize():
            await asyncio.sleep(0.01)
    pushing.cancel()
    for _ in range(10):
        await asyncio.sleep(0)
    await keeper._remove_unneeded()
    cloud.store.free.set()
    with suppress(asyncio.CancelledError):
        await pushing
    assert await before == [None]
    assert [one.sha256 for one in state_service.tables.packages] == [sha256]
    assert keeper.store.held() == {sha256}
