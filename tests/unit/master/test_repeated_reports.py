"""What task sets report once is stored, although the store fails for a while."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest
from support.master_cloud import Cloud, FakePeer, FragileStore, drain, running

from rce.control.messages import Gone, PatchStatus, Status, StatusWanted, VolumeSaved
from rce.control.model import EndpointState, EndpointStatus, LinkAddress, StatusPatch
from rce_master.exceptions import StoreError
from rce_master.packages.contents import ContentStore
from rce_master.snapshots.service import SnapshotService
from rce_master.state import commands
from rce_master.state.settings import StateSettings
from rce_master.state.volume_records import UserVolume

ID = "anna/c"


def status(unix: str = "/run/c", number: int = 1) -> EndpointStatus:
    address = LinkAddress(machine="m", unix=unix)
    return EndpointStatus(
        id=ID, revision=1, state=EndpointState.RUNNING, address=address, number=number, incarnation="i"
    )


def address_in(cloud: Cloud) -> str | None:
    container = cloud.state_service.tables.container(ID)
    assert container is not None
    return container.address.unix


async def until_address(cloud: Cloud, unix: str) -> None:
    async with asyncio.timeout(60):
        while address_in(cloud) != unix:
            await asyncio.sleep(0.01)


@pytest.fixture(autouse=True)
def often(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in ("reports", "snapshots.service"):
        monkeypatch.setattr(f"rce_master.{module}.REPEAT_S", 0.02)


@pytest.fixture
async def containers(cloud: Cloud) -> FakePeer:
    """A task set with a container, which reports to a store that is broken."""
    peer = cloud.containers()
    await peer.hello()
    await cloud.state_service.submit(commands.CreateContainer(user="anna", tag="c"))
    cloud.store.broken = True
    return peer


async def test_lost_status_is_stored_later(cloud: Cloud, containers: FakePeer) -> None:
    await containers.say(Status(status=status()))
    await cloud.flush()
    assert not address_in(cloud), "it could not be stored"
    saves = cloud.store.saves
    while cloud.store.saves < saves + 3:  # it is tried again
        await asyncio.sleep(0.01)
    assert not address_in(cloud)
    cloud.store.broken = False
    await until_address(cloud, "/run/c")


async def test_newest_of_lost_reports_is_stored(cloud: Cloud, containers: FakePeer) -> None:
    for number in range(1, 4):
        await containers.say(Status(status=status(f"/run/{number}", number)))
    await cloud.flush()
    cloud.store.broken = False
    await until_address(cloud, "/run/3")
    saves = cloud.store.saves
    await asyncio.sleep(0.1)
    assert cloud.store.saves == saves, "each is stored once"
    assert address_in(cloud) == "/run/3"


async def test_stored_report_replaces_a_lost_one(cloud: Cloud, containers: FakePeer) -> None:
    """The older one must not come after the newer one."""
    await containers.say(Status(status=status("/run/1", 1)))
    await cloud.flush()
    cloud.store.broken = False
    await containers.say(Status(status=status("/run/2", 2)))
    await until_address(cloud, "/run/2")
    await asyncio.sleep(0.1)
    assert address_in(cloud) == "/run/2"


async def test_lost_patch_lets_the_master_ask_for_the_whole(cloud: Cloud, containers: FakePeer) -> None:
    cloud.store.broken = False
    await containers.say(Status(status=status("/run/1", 1)))
    await cloud.flush()
    drain(containers)
    cloud.store.broken = True
    await containers.say(PatchStatus(patch=StatusPatch(status=status("/run/2", 2))))
    assert (await containers.get(StatusWanted)).id == ID
    await containers.say(Status(status=status("/run/2", 2)))
    await cloud.flush()
    cloud.store.broken = False
    await until_address(cloud, "/run/2")


async def test_reports_before_a_new_connection_are_forgotten(cloud: Cloud, containers: FakePeer) -> None:
    await containers.say(Gone(id=ID, revision=1))
    await cloud.flush()
    await cloud.control_handler.on_gone(containers)
    cloud.store.broken = False
    back = cloud.containers()
    await back.hello(status("/run/new"))
    await asyncio.sleep(0.1)
    assert cloud.state_service.tables.is_connected("c1")
    assert address_in(cloud) == "/run/new"


@asynccontextmanager
async def busy() -> AsyncIterator[Cloud]:
    """Run a cloud whose next commands continue work that a broken store does not take."""
    async with running(FragileStore(), StateSettings(max_work=1)) as cloud:
        await cloud.robots().hello()
        for number in range(200):
            await cloud.state_service.submit(commands.CreateContainer(user="anna", tag=f"c{number}"))
        await cloud.containers().hello()
        cloud.store.broken = True
        yield cloud


async def test_lost_departure_is_stored_later() -> None:
    async with busy() as cloud:
        with pytest.raises(StoreError, match="disk full"):
            await cloud.state_service.submit(commands.CreateContainer(user="anna", tag="more"))
        await cloud.reconciler.on_gone(cloud.reconciler._peers["r1"])
        assert cloud.state_service.tables.is_connected("r1"), "it places containers too, which is not stored"
        cloud.store.broken = False
        async with asyncio.timeout(60):
            while cloud.state_service.tables.is_connected("r1"):
                await asyncio.sleep(0.01)


async def test_report_is_not_lost_with_work_that_is_left_over() -> None:
    """It needs no store; the work that is done in the same transaction does."""
    async with busy() as cloud:
        report = commands.FaultReported(id="anna/c", text="a fault")
        assert await cloud.state_service.submit_all([report]) == [None]
        cloud.store.broken = False


async def test_end_of_snapshot_is_stored_later(cloud: Cloud, tmp_path: Path) -> None:
    volumes = cloud.state_service.tables.volumes
    volume = UserVolume(user="anna", name="v", size=1, process="c1", placement=1)
    volumes.assign(volume.id, volume)
    service = SnapshotService(cloud.state_service, ContentStore(tmp_path))
    cloud.store.broken = True
    saved = VolumeSaved(volume=volume.id, placement=1, error="no room")
    accepting = asyncio.create_task(service.accept("c1", saved))
    saves = cloud.store.saves
    while cloud.store.saves < saves + 3:
        await asyncio.sleep(0.01)
    cloud.store.broken = False
    await accepting
    assert volumes[volume.id].fault == "no room"
