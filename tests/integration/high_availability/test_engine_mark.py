"""Whose state is below a prefix of etcd: engines differ by their secrets, which are rotated."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest
from support.engine import until

from rce.config.secret import Secret, new_secret, read_secret, retire_secrets, rotate_secret
from rce_master.exceptions import StoreError
from rce_master.leadership import engine_mark
from rce_master.leadership.engine_mark import EngineMark
from rce_master.store.etcd import EtcdClient
from rce_master.store.etcd.layout import Keys
from rce_master.store.etcd.wire import Put

pytestmark = [pytest.mark.needs("etcd"), pytest.mark.asyncio(loop_scope="module")]

PREFIX = "/rce"


async def test_another_engine_is_refused(client: EtcdClient) -> None:
    own, other = Secret("the secret of this engine"), Secret("the secret of another one")
    for _ in range(2):
        await EngineMark(client, PREFIX, own).check()
    with pytest.raises(StoreError, match=r"below /rce/ of etcd is the state of another engine"):
        await EngineMark(client, PREFIX, other).check()
    await EngineMark(client, "/second", other).check()
    found = await client.get(Keys(PREFIX).engine)
    assert found is not None
    assert b"secret of this" not in found.value


async def test_mark_follows_the_secret(
    client: EtcdClient, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A master that has the new secret only comes in, one that has the retired one does not."""
    monkeypatch.setattr(engine_mark, "LOOK_S", 0.05)
    file = tmp_path / "secret"
    old = Secret(new_secret(file).reveal())
    prefix = "/rotated"
    mark = EngineMark(client, prefix, read_secret(file))
    await mark.check()
    running = asyncio.create_task(mark.run())
    try:
        rotate_secret(file)
        new = Secret(read_secret(file).reveal())

        async def accepts(secret: Secret) -> bool:
            try:
                await EngineMark(client, prefix, secret).check()
            except StoreError:
                return False
            return True

        await until(lambda: accepts(new), what="the new secret is known")
        assert await accepts(old)
        retire_secrets(file)

        async def refuses_old() -> bool:
            return not await accepts(old)

        await until(refuses_old, what="the old secret is forgotten")
        assert await accepts(new)
    finally:
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)


async def test_overwritten_mark_is_named(client: EtcdClient) -> None:
    await client.transact([], [Put(Keys("/broken").engine, b"no mark")])
    with pytest.raises(StoreError, match="/broken/engine of etcd was overwritten"):
        await EngineMark(client, "/broken", Secret("the secret of this engine")).check()
