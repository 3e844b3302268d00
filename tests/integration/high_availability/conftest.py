"""A real etcd for the tests of a module, and a client of it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest_asyncio
from support.etcd import Cluster, cluster

from rce_master.store.etcd.client import EtcdClient

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    import pytest


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def etcd(tmp_path_factory: pytest.TempPathFactory) -> AsyncIterator[Cluster]:
    async with cluster(tmp_path_factory.mktemp("etcd")) as made:
        yield made


@pytest_asyncio.fixture(loop_scope="module")
async def client(etcd: Cluster) -> AsyncIterator[EtcdClient]:
    async with EtcdClient(etcd.endpoints, attempt=20.0) as made:
        yield made
