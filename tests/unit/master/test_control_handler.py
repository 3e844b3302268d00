"""What the control handler tells task sets, and takes from them."""

from __future__ import annotations

import pytest
from support.master_cloud import CX, Cloud, add, drain, wire

from rce.control.desired import DesiredState, Fit
from rce.control.messages import (
    ClientReply,
    ClientRequest,
    Drop,
    Fault,
    Gone,
    LogChunk,
    Notify,
    PatchSpec,
    PatchStatus,
    Put,
    SpecWanted,
    Status,
    StatusWanted,
    Usage,
)
from rce.control.model import PATCHES, EndpointState, EndpointStatus, LinkAddress, StatusPatch
from rce_master.exceptions import NotFoundError, TaskSetAwayError


async def test_everything_is_said_at_hello_and_changes_after_it(cloud: Cloud) -> None:
    robots, containers = cloud.robots(), cloud.containers()
    assert (await robots.hello()).endpoints == ()
    await wire(robots)
    (spec,) = (await containers.hello()).endpoints
    assert [n.tag for n in spec.nodes] == ["n"]
    assert [c.interface for c in spec.connections] == ["in"]
    address = LinkAddress(machine="m", unix="/run/c")
    await containers.say(
        Status(status=EndpointStatus(id="anna/c", revision=1, state=EndpointState.RUNNING, address=address))
    )
    put = await robots.get(Put)
    while not put.endpoint.links or put.endpoint.links[0].address != address:
        put = await robots.get(Put)
    assert put.endpoint.links[0].dial
    await robots.ask("DC", {"containerTag": "c"})
    assert (await containers.get(Drop)).id == "anna/c"


async def test_a_task_set_that_takes_patches_is_sent_what_changed(cloud: Cloud) -> None:
    robots, containers = cloud.robots(), cloud.containers()
    containers.features = frozenset({PATCHES})
    await robots.hello()
    await wire(robots)
    (spec,) = (await containers.hello()).endpoints
    desired = DesiredState(spec)
    for tag in ("x", "y"):
        await robots.ask("CN", add(tag))
        patch = (await containers.get(PatchSpec)).patch
        assert [one.tag for one in patch.interfaces] == [tag]
        assert (patch.links, patch.connections, patch.contents) == ((), (), None)
        assert desired.fit(patch) is Fit.NEXT
        desired.patch(patch)
    await robots.ask("CN", {"removeInterfaces": [{"endpointTag": "c", "interfaceTag": "in"}]})
    patch = (await containers.get(PatchSpec)).patch
    assert patch.removed_interfaces == ("in",)
    assert len(patch.removed_links) == len(patch.removed_connections) == 1
    desired.patch(patch)
    assert desired.whole == cloud.state_service.spec("anna/c")


async def test_a_patch_that_did_not_fit_is_followed_by_the_whole(cloud: Cloud) -> None:
    robots, containers = cloud.robots(), cloud.containers()
    containers.features = frozenset({PATCHES})
    await robots.hello()
    await wire(robots)
    await containers.hello()
    await containers.say(SpecWanted(id="anna/c"))
    put = await containers.get(Put)
    assert put.endpoint == cloud.state_service.spec("anna/c")
    await robots.ask("CN", add("x"))
    assert (await containers.get(PatchSpec)).patch.base == put.endpoint.revision
    await containers.say(SpecWanted(id="anna/rob"))
    await containers.say(SpecWanted(id="anna/nothing"))
    await containers.say(SpecWanted(id="anna/c"))
    assert (await containers.get(Put)).endpoint.id == "anna/c", "others are not placed there"


async def test_status_patches_are_added_up_and_a_gap_asks_once(cloud: Cloud) -> None:
    robots, containers = cloud.robots(), cloud.containers()
    await robots.hello()
    await wire(robots)
    await containers.hello()
    tables = cloud.state_service.tables

    def status(
        number: int, interfaces: dict[str, bool] | None = None, connections: tuple[int, ...] = ()
    ) -> EndpointStatus:
        return EndpointStatus(
            id="anna/c",
            revision=1,
            state=EndpointState.RUNNING,
            number=number,
            interfaces=interfaces or {},
            connections=connections,
        )

    await containers.say(Status(status=status(4, interfaces={"in": False})))
    await containers.say(
        PatchStatus(patch=StatusPatch(status=status(5, interfaces={"in": True}, connections=(1,))))
    )
    await robots.ask("CN", add("x"))
    assert [one.tag for one in tables.active.by("endpoint", "anna/c")] == ["in"]
    assert [one.connection for one in tables.open_ends.by("endpoint", "anna/c")] == [1]
    for number in (7, 8):
        await containers.say(PatchStatus(patch=StatusPatch(status=status(number, interfaces={"in": False}))))
    assert (await containers.get(StatusWanted)).id == "anna/c"
    await containers.say(Status(status=status(9)))
    await containers.say(PatchStatus(patch=StatusPatch(status=status(10), lost_connections=(1,))))
    await robots.ask("CN", add("y"))
    assert not tables.active
    assert not tables.open_ends
    assert not any(isinstance(left, StatusWanted) for left in drain(containers))


async def test_faults_go_to_the_robots_of_the_user(cloud: Cloud) -> None:
    one, two, containers = cloud.robots("r1"), cloud.robots("r2"), cloud.containers()
    for peer in (one, two, containers):
        await peer.hello()
    await wire(one)
    await two.login("second")
    await containers.say(Fault(id="anna/c", text="node n died"))
    assert await one.get(Notify) == Notify(id="anna", text="node n died")
    assert await two.get(Notify) == Notify(id="anna", text="node n died")
    await containers.say(Fault(id="anna/c", text="for one", robot="anna/second"))
    assert (await two.get(Notify)).text == "for one"
    await cloud.flush()
    assert not any(isinstance(one.inbox.get_nowait(), Notify) for _ in range(one.inbox.qsize()))


async def test_a_task_set_that_left_hears_nothing_until_it_is_back(cloud: Cloud) -> None:
    robots, containers = cloud.robots(), cloud.containers()
    await robots.hello()
    await containers.hello()
    await wire(robots)
    await containers.say(Usage(cpu_s=1.0, memory=2, endpoints={}))
    assert "c1" in cloud.reconciler.usage
    await cloud.control_handler.on_gone(containers)
    assert "c1" not in cloud.reconciler.usage
    while not containers.inbox.empty():
        containers.inbox.get_nowait()
    await robots.ask("CN", {"removeNodes": [{"containerTag": "c", "nodeTag": "n"}]})
    assert containers.inbox.empty()
    again = cloud.containers()
    status = EndpointStatus(id="anna/c", revision=1, state=EndpointState.RUNNING)
    (spec,) = (await again.hello(status)).endpoints
    assert spec.nodes == ()
    await cloud.control_handler.on_gone(containers)
    assert cloud.state_service.tables.is_connected("c1"), "the former channel's end is not a loss"


async def test_remade_container_is_put_after_its_predecessor(cloud: Cloud) -> None:
    """A container made again is put when its former self is gone."""
    robots, containers = cloud.robots(), cloud.containers()
    await robots.hello()
    await containers.hello()
    await wire(robots)
    await robots.ask("DC", {"containerTag": "c"})
    await robots.ask("CC", {"containerTag": "c"})
    drop = await containers.get(Drop)
    assert not any(isinstance(containers.inbox.get_nowait(), Put) for _ in range(containers.inbox.qsize()))
    await containers.say(Gone(id="anna/c", revision=drop.revision))
    put = await containers.get(Put)
    assert put.endpoint.id == "anna/c"
    assert put.endpoint.revision > drop.revision


async def test_logs_are_read_where_the_container_is(cloud: Cloud) -> None:
    robots, containers = cloud.robots(), cloud.containers()
    await robots.hello()
    await wire(robots)
    with pytest.raises(TaskSetAwayError, match="cannot be reached"):
        await cloud.reconciler.read_log("anna/c", "n", 0, 10)
    await containers.hello()
    assert (await cloud.reconciler.read_log("anna/c", "n", 0, 10)).text == "hello"
    with pytest.raises(NotFoundError, match="has no node 'x'"):
        await cloud.reconciler.read_log("anna/c", "x", 0, 10)
    containers.log = LogChunk(request=0, offset=0, error="no logs of an earlier life")
    with pytest.raises(NotFoundError, match="no container 'd'"):
        await cloud.reconciler.read_log("anna/d", "x", 0, 10)
    containers.log = LogChunk(request=0, offset=0, error="no such log")
    with pytest.raises(NotFoundError, match="no such log"):
        await cloud.reconciler.read_log("anna/c", "n", 0, 10)
    containers.log = LogChunk(request=0, offset=0, text="away")
    with pytest.raises(TaskSetAwayError, match="did not answer"):
        await cloud.reconciler.read_log("anna/c", "n", 0, 10)


async def test_a_removal_that_was_done_may_be_repeated(cloud: Cloud) -> None:
    """Its answer was lost with the connection, or with the master."""
    robots, containers = cloud.robots(), cloud.containers()
    await robots.hello()
    await containers.hello()
    await wire(robots)

    async def errors(kind: str, data: object, *, repeated: bool) -> tuple[str, ...]:
        asked = ClientRequest(request=99, id="anna/rob", type=kind, data=data, repeated=repeated)
        await robots.say(asked)
        reply = await robots.get(ClientReply)
        assert len(reply.faults) == len(reply.errors)
        return reply.errors

    parts = {
        "removeNodes": [{"containerTag": "c", "nodeTag": "n"}],
        "removeInterfaces": [{"endpointTag": "c", "interfaceTag": "in"}],
        "deleteParam": [{"containerTag": "c", "name": "p"}],
        "setParam": [{"containerTag": "d", "name": "p", "value": 1}],
    }
    removals = (
        ("CX", {"disconnect": CX["connect"]}, 0),
        ("CN", parts, 1),
        ("DC", {"containerTag": "c"}, 0),
    )
    for kind, data, others in removals:
        await errors(kind, data, repeated=False)
        told = await errors(kind, data, repeated=True)
        assert len(told) == others, told
    assert "there is no container 'c'" in "".join(await errors("DC", {"containerTag": "c"}, repeated=False))
    assert "there is no robot or container 'c'" in "".join(await errors("CN", add("x"), repeated=True))


@pytest.mark.parametrize(("most", "code"), [(None, "busy"), (1, "")])
async def test_what_could_not_be_stored_can_be_repeated(cloud: Cloud, most: int | None, code: str) -> None:
    """A full disk may have room later; what the store never takes is not to be repeated."""
    robots, containers = cloud.robots(), cloud.containers()
    await robots.hello()
    await containers.hello()
    await robots.login()
    cloud.store.most, cloud.store.broken = most, most is None
    await robots.say(ClientRequest(request=99, id="anna/rob", type="CC", data={"containerTag": "c"}))
    reply = await robots.get(ClientReply)
    assert len(reply.errors) == 1
    assert [fault.code for fault in reply.faults] == [code]
