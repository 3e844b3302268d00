"""Masters of one name, as on machines that are copies of one image: a majority would be counted wrongly."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import signal
from typing import TYPE_CHECKING

import aiohttp
import pytest
from support.engine import until
from support.etcd import cluster
from support.masters import LOOPBACK, MasterProcess

from rce_master.cluster.engines import EngineMaster, forget_masters
from rce_master.exceptions import MasterError
from rce_master.leadership import registry as registry_module
from rce_master.leadership.registry import MasterRegistry
from rce_master.store.etcd import EtcdClient
from rce_master.store.etcd.layout import Keys, prepare

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from support.etcd import Cluster

    from rce_master.store.etcd.layout import OtherMaster

PATIENT_S = 20.0
FIRST, SECOND = "http://10.0.0.1:9000/", "http://10.0.0.2:9000/"

pytestmark = pytest.mark.needs("etcd")


@contextlib.asynccontextmanager
async def runs(registry: MasterRegistry, url: str) -> AsyncIterator[None]:
    registry.announce(url)
    task = asyncio.create_task(registry.run())
    try:
        yield
    finally:
        task.cancel()
        await asyncio.wait([task])


async def nothing_answers(_: OtherMaster) -> bool:
    return False


async def url_of(registry: MasterRegistry) -> str | None:
    """Return where others find the only master."""
    found = await registry.others()
    return found[0].url if found else None


async def test_a_second_master_of_one_name_ends(tmp_path: Path) -> None:
    """It ends while the first one runs, and takes its place after that."""
    async with cluster(tmp_path / "etcd") as etcd:
        (tmp_path / "second").mkdir()
        first = MasterProcess(tmp_path, "copy", etcd.store, 5.0)
        second = MasterProcess(tmp_path / "second", "copy", etcd.store, 5.0)
        second.argv[second.argv.index("--http-port") + 1] = str(first.http_port)
        second.argv += ["--bind", "127.0.0.2"]
        await first.start(ready="rce-master ready: ")
        with pytest.raises(AssertionError, match="ended with 1"):
            await second.start(ready="rce-master stand-by: ")
        said = second.output().splitlines()[-1]
        assert f"http://{LOOPBACK}:{first.http_port}/, has the name copy:{first.http_port} too" in said
        assert "--machine" in said
        await first.kill()
        await second.start(ready="rce-master ready: ")
        second.send(signal.SIGTERM)
        assert second.process is not None
        assert await second.process.wait() == 0


async def test_of_two_that_start_at_the_same_time_one_gets_the_name(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Both find it free; the later one says so again and again, and is not counted."""
    async with cluster(tmp_path / "etcd") as etcd, EtcdClient(etcd.endpoints, attempt=PATIENT_S) as client:
        await prepare(client, "/rce")
        first, second = (MasterRegistry(client, "/rce", "copy") for _ in range(2))
        reader = MasterRegistry(client, "/rce", "the test")
        for registry in (first, second):
            await registry.check_name(client, nothing_answers)
        async with runs(first, FIRST):
            assert await until(lambda: url_of(reader)) == FIRST
            with caplog.at_level(logging.WARNING):
                async with runs(second, SECOND):
                    await until(lambda: f"{FIRST}, has the name copy too" in caplog.text)
            assert await url_of(reader) == FIRST


async def test_a_master_returns_at_another_address(tmp_path: Path) -> None:
    """Its former address does not answer; while it runs, its address may change too."""
    async with cluster(tmp_path / "etcd") as etcd, EtcdClient(etcd.endpoints, attempt=PATIENT_S) as client:
        await prepare(client, "/rce")
        before, after = (MasterRegistry(client, "/rce", "one") for _ in range(2))
        reader = MasterRegistry(client, "/rce", "the test")
        async with runs(before, FIRST):
            assert await until(lambda: url_of(reader)) == FIRST
        await after.check_name(client, nothing_answers)
        async with runs(after, SECOND):
            await until(lambda: _is_at(reader, SECOND))
            after.announce(FIRST)
            await until(lambda: _is_at(reader, FIRST))

        async def answers(_: OtherMaster) -> bool:
            return True

        with pytest.raises(MasterError, match="has the name one too"):
            await MasterRegistry(client, "/rce", "one").check_name(client, answers)


async def test_removed_master_that_runs_is_counted_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As after ``rce cluster remove`` and ``rce cluster join`` while its master runs on."""
    monkeypatch.setattr(registry_module, "_RENEWAL_S", 0.1)
    async with cluster(tmp_path / "etcd") as etcd, EtcdClient(etcd.endpoints, attempt=PATIENT_S) as client:
        await prepare(client, "/rce")
        registry, reader = (MasterRegistry(client, "/rce", name) for name in ("m3", "the test"))
        async with runs(registry, FIRST):
            await until(lambda: _is_at(reader, FIRST))
            written = await client.get(Keys("/rce").masters + "m3")
            await forget_masters(client, [EngineMaster("m3", "10.0.0.1", "/rce")])

            async def is_written_again() -> bool:
                record = await client.get(Keys("/rce").masters + "m3")
                return record is not None and record != written

            await until(is_written_again)
            assert await url_of(reader) == FIRST
        assert await leases(etcd) == 1


async def test_master_without_its_name_takes_few_leases(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """It tries again and again, and each lease would stay for a day."""
    monkeypatch.setattr(registry_module, "_PAUSE_S", 0.01)
    async with cluster(tmp_path / "etcd") as etcd, EtcdClient(etcd.endpoints, attempt=PATIENT_S) as client:
        await prepare(client, "/rce")
        first, second = (MasterRegistry(client, "/rce", "copy") for _ in range(2))
        reader = MasterRegistry(client, "/rce", "the test")
        async with runs(first, FIRST):
            await until(lambda: _is_at(reader, FIRST))
            with caplog.at_level(logging.DEBUG, registry_module.__name__):
                async with runs(second, SECOND):
                    await until(lambda: caplog.text.count("has the name copy too") >= 5)
        assert await leases(etcd) <= 2


async def leases(etcd: Cluster) -> int:
    """Return how many leases there are."""
    url = f"http://{etcd.members[0].endpoint}/v3/lease/leases"
    async with aiohttp.ClientSession() as session, session.post(url, json={}) as reply:
        return len((await reply.json()).get("leases", ()))


async def test_a_renamed_master_counts_once(tmp_path: Path) -> None:
    async with cluster(tmp_path / "etcd") as etcd, EtcdClient(etcd.endpoints, attempt=PATIENT_S) as client:
        await prepare(client, "/rce")
        before, after = MasterRegistry(client, "/rce", "vm"), MasterRegistry(client, "/rce", "m1")
        reader = MasterRegistry(client, "/rce", "the test")
        async with runs(before, FIRST):
            await until(lambda: _is_at(reader, FIRST))
        async with runs(after, FIRST):

            async def names() -> bool:
                return [master.name for master in await reader.others()] == ["m1"]

            await until(names)
            assert await after.others() == []


async def _is_at(reader: MasterRegistry, url: str) -> bool:
    return await url_of(reader) == url
