"""Logins and requests that task sets hand to the control handler."""

from __future__ import annotations

import asyncio

from support.master_cloud import PASSWORD, Cloud, wire

from rce.control.messages import (
    ClientReply,
    ClientRequest,
    Left,
    Login,
    LoginReply,
    Probe,
    RequestFault,
)
from rce.model import AddNode, ConfigureComponents, CreateContainer, NodeSpec, RemoveInterface, Resources
from rce_master.auth import client_digest
from rce_master.state import commands
from rce_master.state.lifecycle import RobotSession
from rce_master.state.user_records import User, UserRole
from rce_master.tokens import new_token


async def test_a_logins_answer_carries_the_spec_and_no_put_precedes_it(cloud: Cloud) -> None:
    robots = cloud.robots()
    await robots.hello()
    reply = await robots.login()
    assert reply.endpoint is not None
    assert reply.endpoint.id == "anna/rob"
    assert robots.inbox.empty()


async def test_logins_that_are_refused_say_why(cloud: Cloud) -> None:
    robots, containers = cloud.robots(), cloud.containers()
    await robots.hello()
    wrong = await robots.login(password=client_digest("wrong"))
    assert (wrong.status, wrong.endpoint) == (401, None)
    assert (await robots.login()).status == 200
    twice = await robots.login()
    assert twice.status == 409
    assert "connected already" in twice.reason
    await containers.hello()
    await robots.ask("CC", {"containerTag": "c"})
    assert (await robots.login("c")).status == 409
    cloud.store.broken = True
    assert (await robots.login("other")).status == 503
    cloud.store.broken = False


async def test_a_robot_that_is_connected_elsewhere_is_looked_after(cloud: Cloud) -> None:
    first, second = cloud.robots(), cloud.robots("r2")
    for peer in (first, second):
        await peer.hello()
    await first.login()
    assert (await first.login()).status == 409
    assert first.inbox.empty(), "its own task set probes it by itself"
    assert (await second.login(password=client_digest("wrong"))).status == 401
    assert first.inbox.empty(), "strangers bother nobody"
    assert (await second.login()).status == 409
    assert await first.get(Probe) == Probe(id="anna/rob")
    await first.say(Left(id="anna/rob", reason="it does not answer"))
    await cloud.flush()
    assert (await second.login()).status == 200


async def test_a_silent_task_set_is_given_up_for_its_robots(cloud: Cloud) -> None:
    """It hangs or was cut off; its robots would have to wait until its connection counts as lost."""
    first, second = cloud.robots(), cloud.robots("r2")
    for peer in (first, second):
        await peer.hello()
    await first.login()
    first.silence = 3.0
    assert (await second.login()).status == 409
    assert first.aborts == 0, "each is silent for a while"
    first.silence = 4.0
    assert (await second.login()).status == 409
    assert first.aborts == 1
    await cloud.control_handler.on_gone(first)
    assert (await second.login()).status == 200


async def test_robot_leaving_during_login_is_disconnected(cloud: Cloud) -> None:
    """A robot that leaves while it logs in is not connected for ever."""
    robots = cloud.robots()
    await robots.hello()
    await robots.say(Login(request=1, user="anna", robot="rob", password=PASSWORD))
    await robots.say(Left(id="anna/rob", reason="gone"))
    await robots.get(LoginReply)
    assert (await robots.login()).status == 200


async def test_robot_sent_away_while_logging_in_is_refused(cloud: Cloud) -> None:
    """The command that ends the session is done in the same batch as the login, so before its answer."""
    robots = cloud.robots()
    await robots.hello()
    token, record = new_token("anna", "", 0.0, 0.0, scope="robot:rob")
    await cloud.state_service.submit(commands.AddToken(token=record))
    cloud.store.free.clear()
    bob = User(name="bob", role=UserRole.USER, password="", created=0.0)
    written = await cloud.state_service.enqueue([commands.AddUser(user=bob)])
    await asyncio.sleep(0)
    await robots.say(Login(request=1, user="anna", robot="rob", password="", token=token))
    await asyncio.sleep(0)
    revoked = await cloud.state_service.enqueue([commands.RevokeRobotToken(user="anna", robot="rob")])
    cloud.store.free.set()
    assert [await written, await revoked] == [[None], [None]]
    reply = await robots.get(LoginReply)
    assert (reply.status, reply.endpoint) == (503, None)
    assert "sent away while it logged in" in reply.reason
    assert cloud.state_service.tables.robot_live("anna/rob").session is RobotSession.ABSENT


async def test_every_bad_item_is_told_and_the_others_are_done(cloud: Cloud) -> None:
    robots = cloud.robots()
    await robots.hello()
    await wire(robots)
    errors = await robots.ask(
        "CN",
        {
            "addNodes": [
                {"containerTag": "c", "nodeTag": "good", "pkg": "Test", "exe": "x.py"},
                {"containerTag": "none", "nodeTag": "n", "pkg": "Test", "exe": "x.py"},
                {"containerTag": "c", "nodeTag": "9bad", "pkg": "Test", "exe": "x.py"},
            ],
            "setParam": [{"containerTag": "c", "name": "p", "value": 2**40}],
        },
    )
    assert len(errors) == 3
    assert any("addNodes[2].nodeTag" in error for error in errors)
    assert any("there is no container 'none'" in error for error in errors)
    assert any("32 bits" in error for error in errors)
    assert {n.tag for n in cloud.state_service.spec("anna/c").nodes} == {"n", "good"}
    assert len(await robots.ask("XX", {})) == 1
    assert len(await robots.ask("CN", "nonsense")) == 1
    assert "connect again" in (await robots.ask("CC", {"containerTag": "d"}, robot="stranger"))[0]


async def test_refusal_carries_its_code_and_what_it_is_about(cloud: Cloud) -> None:
    robots = cloud.robots()
    await robots.hello()
    await wire(robots)
    node = NodeSpec(tag="n", pkg="Test", exe="x.py")
    content = ConfigureComponents(
        add_nodes=(AddNode(container="none", node=node), AddNode(container="c", node=node)),
        remove_interfaces=(RemoveInterface(endpoint="c", tag="away"),),
    )
    await robots.say(ClientRequest(request=9, id="anna/rob", type="CN", data=None, content=content))
    reply = await robots.get(ClientReply)
    assert reply.faults == (
        RequestFault(code="not_found", ids={"endpoint": "c", "interface": "away"}),
        RequestFault(code="not_found", ids={"container": "none", "node": "n"}),
    )
    assert len(reply.errors) == 2
    await robots.say(
        ClientRequest(
            request=10,
            id="anna/rob",
            type="CC",
            data=None,
            content=CreateContainer(tag="c", resources=Resources(cpu=2)),
        )
    )
    (fault,) = (await robots.get(ClientReply)).faults
    assert fault == RequestFault(code="conflict", ids={"container": "c"})


async def test_one_message_can_replace_something(cloud: Cloud) -> None:
    robots = cloud.robots()
    await robots.hello()
    await wire(robots)
    new = {"containerTag": "c", "nodeTag": "n", "pkg": "Test", "exe": "other.py"}
    old = {"containerTag": "c", "nodeTag": "n"}
    assert await robots.ask("CN", {"addNodes": [new], "removeNodes": [old]}) == ()
    assert [n.exe for n in cloud.state_service.spec("anna/c").nodes] == ["other.py"]


async def test_requests_of_one_channel_are_done_in_order(cloud: Cloud) -> None:
    robots = cloud.robots()
    await robots.hello()
    await robots.login()
    for number in range(20):
        kind = "CC" if number % 2 == 0 else "DC"
        await robots.say(ClientRequest(request=number, id="anna/rob", type=kind, data={"containerTag": "c"}))
    replies = [await robots.get(ClientReply) for _ in range(20)]
    assert [(r.request, r.errors) for r in replies] == [(number, ()) for number in range(20)]
