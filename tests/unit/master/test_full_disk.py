"""What a folder of archives tells of a disk that was full."""

from __future__ import annotations

import errno
import os
from collections.abc import AsyncIterator
from pathlib import Path

import pytest

from rce_master.exceptions import StoreError
from rce_master.packages import contents
from rce_master.packages.contents import ContentStore


async def receive(store: ContentStore) -> None:
    async def pieces() -> AsyncIterator[bytes]:
        yield b"archive"

    async with store.receive(pieces()) as incoming:
        await store.keep(incoming)


async def test_a_full_disk_is_told_until_an_archive_is_kept(tmp_path: Path) -> None:
    store = ContentStore(tmp_path, noun="snapshot")
    said = "the master cannot keep the snapshot: No space left on device"

    def fail(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(contents, "_append", fail)
        with pytest.raises(StoreError, match=said):
            await receive(store)
    assert store.fault == said
    await receive(store)
    assert store.fault == ""


async def test_an_upload_that_breaks_is_not_a_full_disk(tmp_path: Path) -> None:
    store = ContentStore(tmp_path)

    async def broken() -> AsyncIterator[bytes]:
        yield b"arch"
        raise ConnectionResetError

    with pytest.raises(StoreError):
        async with store.receive(broken()):
            pass
    assert store.fault == ""
