"""The state service, the reconciler and the desk, with task sets that live in the test."""

from __future__ import annotations

import asyncio

import pytest
from support.master_cloud import Cloud, FragileStore, running, wire

from rce.aio.tasks import cancel_and_wait
from rce.control.messages import (
    Drop,
    Put,
    Status,
)
from rce.control.model import EndpointState, EndpointStatus, LinkAddress
from rce_master.exceptions import EndedError, MasterError, NotFoundError, SaveTooLargeError, StoreError
from rce_master.state import commands
from rce_master.state.settings import StateSettings
from rce_master.state_service import MAX_WAITING, StateService

# StateService


async def test_nothing_changes_if_it_cannot_be_stored(cloud: Cloud) -> None:
    heard: list[object] = []
    cloud.state_service.listeners.append(heard.append)
    cloud.store.broken = True
    with pytest.raises(StoreError, match="disk full"):
        await cloud.state_service.submit(commands.CreateContainer(user="anna", tag="c"))
    assert heard == []
    assert len(cloud.state_service.tables.endpoints) == 0
    cloud.store.broken = False
    await cloud.state_service.submit(commands.CreateContainer(user="anna", tag="c"))
    assert len(heard) == 1


async def test_a_tick_finds_out_that_the_store_is_repaired(cloud: Cloud) -> None:
    cloud.store.broken = True
    with pytest.raises(StoreError, match="disk full"):
        await cloud.state_service.submit(commands.CreateContainer(user="anna", tag="c"))
    await cloud.flush()
    with pytest.raises(StoreError, match="disk full"):
        await cloud.state_service.check_store()
    cloud.store.broken = False
    await cloud.flush()
    await cloud.flush()  # it is tried after the first one was answered
    await cloud.state_service.check_store()
    saves = cloud.store.saves
    await cloud.flush()
    await cloud.flush()
    assert cloud.store.saves == saves


async def test_reports_do_not_suffer_from_a_broken_store(cloud: Cloud) -> None:
    robots = cloud.robots()
    await robots.hello()
    cloud.store.broken = True
    cloud.store.free.clear()
    creating = asyncio.ensure_future(
        cloud.state_service.submit(commands.CreateContainer(user="anna", tag="a"))
    )
    await asyncio.sleep(0)
    more = asyncio.ensure_future(cloud.state_service.submit(commands.CreateContainer(user="anna", tag="b")))
    leaving = asyncio.ensure_future(cloud.control_handler.on_gone(robots))
    await asyncio.sleep(0)
    cloud.store.free.set()
    await leaving
    assert not cloud.state_service.tables.is_connected("r1")
    for refused in (creating, more):
        with pytest.raises(StoreError, match="disk full"):
            await refused
    assert len(cloud.state_service.tables.endpoints) == 0
    cloud.store.broken = False


async def test_changes_are_stored_before_anybody_hears_of_them(cloud: Cloud) -> None:
    stored: list[bool] = []
    cloud.state_service.listeners.append(lambda _: stored.append("anna/c" in cloud.store.tables["endpoints"]))
    await cloud.state_service.submit(commands.CreateContainer(user="anna", tag="c"))
    assert stored == [True]


async def test_a_storm_is_stored_at_once(cloud: Cloud) -> None:
    cloud.store.free.clear()
    saves = cloud.store.saves
    made = [
        asyncio.ensure_future(cloud.state_service.submit(commands.CreateContainer(user="anna", tag=f"c{i}")))
        for i in range(100)
    ]
    await asyncio.sleep(0)
    cloud.store.free.set()
    await asyncio.gather(*made)
    assert cloud.store.saves - saves <= 2
    assert len(cloud.store.tables["endpoints"]) == 100


async def test_work_that_is_left_over_is_continued() -> None:
    """A command that leaves work is answered; the rest is done at once, in turns with others."""
    count = 100
    async with running(FragileStore(), StateSettings(max_work=1)) as cloud:
        for number in range(count):
            await cloud.state_service.submit(commands.CreateContainer(user="anna", tag=f"c{number}"))
        await cloud.containers().hello()
        others = 0
        while any(not c.task_set for c in cloud.state_service.tables.containers()):
            await cloud.state_service.submit(commands.SpecRequested(process="c1", id="anna/none"))
            others += 1
        assert others <= count, "each command is followed by a piece of the work"


async def test_long_batch_lets_others_have_their_turn(cloud: Cloud, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rce_master.state_service.MAX_HOLD_S", 0.0)
    count = 50
    creating = asyncio.ensure_future(
        cloud.state_service.submit_all(
            [commands.CreateContainer(user="anna", tag=f"c{number}") for number in range(count)]
        )
    )
    others = 0
    while not creating.done():
        await asyncio.sleep(0)
        others += 1
    assert others > count
    assert await creating == [None] * count


async def test_store_that_fails_leaves_work_to_the_next_tick() -> None:
    async with running(FragileStore(), StateSettings(max_work=1)) as cloud:
        for number in range(200):
            await cloud.state_service.submit(commands.CreateContainer(user="anna", tag=f"c{number}"))
        await cloud.containers().hello()
        cloud.store.broken = True
        with pytest.raises(StoreError, match="disk full"):
            await cloud.state_service.submit(commands.CreateContainer(user="anna", tag="more"))
        saves = cloud.store.saves
        for _ in range(100):
            await asyncio.sleep(0)
        assert cloud.store.saves <= saves + 1, "a store that fails is not asked again and again"
        assert any(not c.task_set for c in cloud.state_service.tables.containers())
        cloud.store.broken = False
        await cloud.state_service.submit(commands.Tick())
        while any(not c.task_set for c in cloud.state_service.tables.containers()):
            await asyncio.sleep(0)


async def test_a_tick_whose_save_is_too_large_is_followed_by_a_smaller_one() -> None:
    """Else no grace time would end any more."""
    async with running(FragileStore(), StateSettings(robot_grace=0.0)) as cloud:
        robots = cloud.robots()
        await robots.hello()
        for number in range(100):
            await cloud.state_service.submit(commands.RobotLogin(process="r1", id=f"anna/rob{number}"))
            await cloud.state_service.submit(commands.RobotLeft(process="r1", id=f"anna/rob{number}"))
        cloud.store.most = 50
        with pytest.raises(SaveTooLargeError):
            await cloud.state_service.submit(commands.Tick())
        assert len(cloud.state_service.tables.endpoints) == 100
        await cloud.state_service.submit(commands.Tick())
        assert len(cloud.state_service.tables.endpoints) < 100
        cloud.store.most = None
        while cloud.state_service.tables.endpoints:
            await asyncio.sleep(0)


async def test_of_several_commands_only_the_bad_ones_are_refused(cloud: Cloud) -> None:
    outcomes = await cloud.state_service.submit_all(
        [
            commands.CreateContainer(user="anna", tag="c"),
            commands.DestroyContainer(user="anna", tag="none"),
            commands.CreateContainer(user="anna", tag="d"),
        ]
    )
    assert [type(outcome) for outcome in outcomes] == [type(None), NotFoundError, type(None)]
    assert await cloud.state_service.submit_all([]) == []


async def test_a_fault_of_ours_is_no_end(cloud: Cloud, caplog: pytest.LogCaptureFixture) -> None:
    with pytest.raises(MasterError, match="internal error"):
        await cloud.state_service.submit("nonsense")  # type: ignore[arg-type]  # it is refused
    assert "could not apply 'nonsense'" in caplog.text
    await cloud.state_service.submit(commands.CreateContainer(user="anna", tag="c"))


@pytest.mark.slow
async def test_commands_fail_once_a_listener_failed() -> None:
    """Its master ends; its callers get an error."""
    store = FragileStore()
    service = await StateService.open(store)

    def fail(_: object) -> None:
        raise RuntimeError("a bug")

    service.listeners.append(fail)
    tasks = [asyncio.create_task(service.submit(commands.Tick())) for _ in range(MAX_WAITING + 10)]
    await asyncio.sleep(0)
    with pytest.raises(RuntimeError, match="a bug"):
        await service.run()
    outcomes = await asyncio.gather(*tasks, return_exceptions=True)
    assert {type(outcome) for outcome in outcomes} == {EndedError}
    with pytest.raises(EndedError):
        await service.submit(commands.Tick())
    with pytest.raises(EndedError):
        await service.settled()


async def test_commands_fail_after_the_service_was_cancelled() -> None:
    service = await StateService.open(FragileStore())
    running = asyncio.create_task(service.run())
    await service.submit(commands.Tick())
    await cancel_and_wait(running)
    with pytest.raises(EndedError):
        await service.submit(commands.Tick())


# Reconciling


async def test_spec_of_endpoint_removed_in_same_batch(cloud: Cloud) -> None:
    """The listener hears of the request when the endpoint is gone already."""
    containers = cloud.containers()
    await containers.hello()
    await cloud.state_service.submit(commands.CreateContainer(user="anna", tag="c"))
    outcomes = await cloud.state_service.submit_all(
        [
            commands.SpecRequested(process="c1", id="anna/c"),
            commands.DestroyContainer(user="anna", tag="c"),
        ]
    )
    assert outcomes == [None, None]
    assert (await containers.get(Drop)).id == "anna/c"
    await cloud.flush()


async def test_a_restarted_master_takes_over_what_runs() -> None:
    store = FragileStore()
    address = LinkAddress(machine="m", unix="/run/c")
    running_c = EndpointStatus(id="anna/c", revision=1, state=EndpointState.RUNNING, address=address)
    async with running(store) as cloud:
        robots, containers = cloud.robots(), cloud.containers()
        await robots.hello()
        await containers.hello()
        await wire(robots)
        await containers.say(Status(status=running_c))
        await cloud.flush()
        before = cloud.state_service.spec("anna/rob"), cloud.state_service.spec("anna/c")
    async with running(store) as cloud:
        robots, containers = cloud.robots(), cloud.containers()
        status = EndpointStatus(id="anna/rob", revision=before[0].revision, state=EndpointState.RUNNING)
        assert (await robots.hello(status)).endpoints == (before[0],)
        assert (await containers.hello(running_c)).endpoints == (before[1],)
        assert robots.inbox.empty(), "nothing changed, so nothing is to be said"
        assert await robots.ask("CC", {"containerTag": "second"}) == ()
        assert (await containers.get(Put)).endpoint.id == "anna/second"
        twice = await robots.login()
        assert twice.status == 409


async def test_a_request_of_many_parts_is_stored_and_sent_once(cloud: Cloud) -> None:
    robots, containers = cloud.robots(), cloud.containers()
    await robots.hello()
    await containers.hello()
    await wire(robots)
    await cloud.flush()
    while not containers.inbox.empty():
        containers.inbox.get_nowait()
    parts = [{"containerTag": "c", "name": f"p{number}", "value": number} for number in range(50)]
    assert await robots.ask("CN", {"setParam": parts}) == ()
    put = await containers.get(Put)
    assert len(put.endpoint.parameters) == 50
    assert put.endpoint.revision == cloud.state_service.spec("anna/c").revision
    assert containers.inbox.empty()
