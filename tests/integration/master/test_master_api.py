"""The REST API on real sockets."""

from __future__ import annotations

import asyncio
import io
import json
import time
from typing import TYPE_CHECKING, Any

import pytest

from rce.control.logs import LogLevel, LogQuery, LogStream
from rce.control.messages import Drop, Put
from rce.control.model import (
    EndpointState,
    EndpointStatus,
    LinkAddress,
    NodeState,
    NodeStatus,
)
from rce_master.auth import client_digest
from rce_master.state.settings import StateSettings

if TYPE_CHECKING:
    from integration.master.conftest import RunSite, Site

INTERFACE = {"tag": "in", "type": "PublisherInterface", "cls": "std_msgs/String", "addr": "/in"}


async def test_tokens(site: Site) -> None:
    for body in ({"userID": "testUser", "password": "wrong"}, {"userID": "nobody", "password": "x"}):
        assert "error" in await site.api("POST", "/login", body, token="", status=401)
    await site.api("GET", "/containers", token="", status=401)
    await site.api("GET", "/containers", token="rce_wrong", status=401)
    token = await site.login()
    assert (await site.api("GET", "/user", token=token))["role"] == "admin"
    await site.api("DELETE", "/login", token=token, status=204)
    await site.api("GET", "/user", token=token, status=401)


async def test_bad_requests_say_what_is_wrong(site: Site) -> None:
    reply = await site.api("POST", "/containers", {"tag": "c", "cpus": 1, "size": "big"}, status=422)
    assert "cpus" in reply["error"]
    assert "size" in reply["error"]
    reply = await site.api("POST", "/containers", {"tag": "9c"}, status=422)
    assert "tag: must be a name" in reply["error"]
    assert "error" in await site.api("GET", "/nothing", status=404)
    assert "error" in await site.api("PATCH", "/containers", status=405)
    async with site.session.post(
        f"{site.url}api/v1/containers", data=b"{" * 10, headers={"Authorization": f"Bearer {site.token}"}
    ) as raw:
        assert raw.status == 422
    async with site.session.post(
        f"{site.url}api/v1/containers",
        data=io.BytesIO(b" " * (2 << 20)),
        headers={"Authorization": f"Bearer {site.token}"},
    ) as raw:
        assert raw.status == 413
        assert "error" in await raw.json()


async def test_users_are_managed_by_administrators(site: Site) -> None:
    await site.api("POST", "/users", {"name": "anna", "password": "one"}, status=201)
    await site.api("POST", "/users", {"name": "anna", "password": "one"}, status=409)
    await site.api("POST", "/users", {"name": "9", "password": "one"}, status=422)
    anna = await site.login("anna", "one")
    await site.api("GET", "/users", token=anna, status=403)
    await site.api("GET", "/machines", token=anna, status=403)
    await site.api("PUT", "/users/testUser/password", {"password": "x"}, token=anna, status=403)
    for body, status in (({}, 422), ({"old_password": "wrong"}, 403), ({"old_password": "one"}, 204)):
        await site.api("PUT", "/users/anna/password", {"password": "two", **body}, token=anna, status=status)
    await site.api("GET", "/user", token=anna, status=401)
    anna = await site.login("anna", "two")
    assert [u["name"] for u in (await site.api("GET", "/users"))["users"]] == ["testUser", "anna"]
    await site.api("DELETE", "/users/anna", status=204)
    await site.api("GET", "/user", token=anna, status=401)
    await site.api("DELETE", "/users/anna", status=404)


async def test_a_large_user_is_removed_by_one_request(run_site: RunSite) -> None:
    """Though the state takes several steps for it."""
    async with run_site(state=StateSettings(max_work=1)) as site:
        await site.api("POST", "/users", {"name": "anna", "password": "one"}, status=201)
        anna = await site.login("anna", "one")
        for tag in ("a", "b", "c"):
            await site.api("POST", "/containers", {"tag": tag}, token=anna, status=204)
        await site.api("DELETE", "/users/anna", status=204)
        assert [user["name"] for user in (await site.api("GET", "/users"))["users"]] == ["testUser"]
        await site.api("POST", "/users", {"name": "anna", "password": "two"}, status=201)
        anna = await site.login("anna", "two")
        assert (await site.api("GET", "/containers", token=anna))["containers"] == []


async def test_everybody_sees_their_own(site: Site) -> None:
    await site.api("POST", "/users", {"name": "anna", "password": "one"}, status=201)
    anna = await site.login("anna", "one")
    await site.api("POST", "/containers", {"tag": "mine"}, token=anna, status=204)
    await site.api("POST", "/containers", {"tag": "theirs"}, status=204)

    async def tags(token: str, user: str = "") -> list[str]:
        whose = await (
            site.api("GET", "/containers", token=token, user=user)
            if user
            else site.api("GET", "/containers", token=token)
        )
        return [c["tag"] for c in whose["containers"]]

    assert await tags(anna) == ["mine"]
    assert await tags(site.token) == ["mine", "theirs"]
    assert await tags(site.token, user="anna") == ["mine"]
    await site.api("GET", "/containers", token=anna, status=403, user="testUser")
    await site.api("GET", "/containers", status=404, user="nobody")
    await site.api("DELETE", "/containers/theirs", token=anna, status=404)
    await site.api("DELETE", "/containers/mine", status=204, user="anna")
    assert await tags(anna) == []


async def test_control_reaches_task_sets_and_their_reports_are_shown(site: Site) -> None:
    async with site.robots() as robots, site.containers() as containers:
        assert (await robots.channel.login("testUser", "rob", client_digest("testUser"))).status == 200
        await site.api("POST", "/containers", {"tag": "c", "cpu": 1}, status=204)
        node = {"tag": "n", "pkg": "Test", "exe": "x.py"}
        await site.api("POST", "/containers/c/nodes", node, status=204)
        await site.api("PUT", "/containers/c/parameters", {"name": "/a/b", "value": [1, "x"]}, status=204)
        await site.api("POST", "/endpoints/c/interfaces", INTERFACE, status=204)
        out = {"tag": "out", "type": "SubscriberConverter", "cls": "std_msgs/String"}
        await site.api("POST", "/endpoints/rob/interfaces", out, status=204)
        await site.api("POST", "/connections", {"tag_a": "rob/out", "tag_b": "c/in"}, status=204)
        put = await containers.get(Put)
        while not put.endpoint.connections:
            put = await containers.get(Put)
        assert [n.tag for n in put.endpoint.nodes] == ["n"]
        (connection,) = put.endpoint.connections
        containers.report(
            EndpointStatus(
                id="testUser/c",
                revision=put.endpoint.revision,
                state=EndpointState.RUNNING,
                incarnation="one",
                nodes=(NodeStatus(tag="n", state=NodeState.RUNNING, pid=7),),
                interfaces={"in": True},
                connections=(connection.id,),
                address=LinkAddress(machine="m", unix="/x"),
            )
        )
        robots.report(
            EndpointStatus(
                id="testUser/rob", revision=1, state=EndpointState.RUNNING, connections=(connection.id,)
            )
        )

        async def shown() -> dict[str, Any]:
            names = ("containers", "nodes", "parameters", "interfaces", "connections", "robots", "machines")
            return {name: (await site.api("GET", f"/{name}"))[name] for name in names}

        while not (await shown())["connections"][0]["established"]:
            await asyncio.sleep(0)
        found = await shown()
        assert (found["containers"][0]["state"], found["containers"][0]["machine"]) == ("running", "machine")
        assert (found["nodes"][0]["state"], found["nodes"][0]["pid"]) == ("running", 7)
        assert found["parameters"] == [
            {"user": "testUser", "container": "c", "name": "/a/b", "value": [1, "x"]}
        ]
        assert {i["tag"]: i["active"] for i in found["interfaces"]} == {"in": True, "out": False}
        assert found["robots"][0]["state"] == "connected"
        assert {m["process"]: m["connected"] for m in found["machines"]} == {"r1": True, "c1": True}

        await site.api("DELETE", "/connections", status=204, tag_a="c/in", tag_b="rob/out")
        await site.api("DELETE", "/endpoints/c/interfaces/in", status=204)
        await site.api("DELETE", "/containers/c/parameters", status=204, name="/a/b")
        await site.api("DELETE", "/containers/c/parameters", status=422)
        await site.api("DELETE", "/containers/c/nodes/n", status=204)
        await site.api("DELETE", "/containers/c", status=204)
        assert (await containers.get(Drop)).id == "testUser/c"
        assert "there is no container" in (await site.api("DELETE", "/containers/c", status=404))["error"]


async def test_logs_are_followed_by_offset(site: Site) -> None:
    async with site.containers() as containers:
        containers.log = b"hello world"
        await site.api("POST", "/containers", {"tag": "c"}, status=204)
        await site.api("POST", "/containers/c/nodes", {"tag": "n", "pkg": "Test", "exe": "x"}, status=204)
        chunk = await site.api("GET", "/containers/c/nodes/n/log", limit=5)
        assert (chunk["text"], chunk["offset"], chunk["ended"]) == ("hello", 5, None)
        chunk = await site.api("GET", "/containers/c/nodes/n/log", offset=5)
        assert (chunk["text"], chunk["offset"]) == (" world", 11)
        assert (await site.api("GET", "/containers/c/log"))["text"] == "hello world"
        await site.api("GET", "/containers/c/nodes/none/log", status=404)
        await site.api("GET", "/containers/c/log", status=422, limit=0)
        for wrong in ({"stream": "stdout,nothing"}, {"level": "loud"}):
            reply = await site.api("GET", "/containers/c/log", status=422, **wrong)
            assert "must be one of" in reply["error"]
        await site.api("GET", "/containers/c/log", stream="rosout,stderr", level="warn", life="abc")
        assert containers.asked[-1].query == LogQuery(
            streams=(LogStream.ROSOUT, LogStream.STDERR),
            level=LogLevel.WARN,
            incarnation="abc",
            since=containers.asked[-1].query.since,
        )
        assert containers.asked[-1].query.since > 0
        await site.api("GET", "/containers/gone/nodes/n/log", previous="true")
        assert (containers.asked[-1].id, containers.asked[-1].query.previous) == ("testUser/gone", True)
        for offset in ("x", "9" * 40, "-" + "9" * 40, "9" * 5000):
            await site.api("GET", "/containers/c/log", status=422, offset=offset)
    while (await site.api("GET", "/machines"))["machines"][0]["connected"]:
        await asyncio.sleep(0)
    assert "cannot be reached" in (await site.api("GET", "/containers/c/log", status=503))["error"]


async def read_events(site: Site, count: int, token: str, last: int | None = None, **query: int) -> list[Any]:
    headers = {"Authorization": f"Bearer {token}"} | ({} if last is None else {"Last-Event-ID": str(last)})
    found: list[Any] = []
    async with site.session.get(f"{site.url}api/v1/events", headers=headers, params=query) as reply:
        assert reply.headers["Content-Type"] == "text/event-stream"
        async for line in reply.content:
            if line.startswith(b"data: "):
                found.append(json.loads(line[6:]))
                if len(found) == count:
                    return found
    return found


async def test_events_are_followed_and_resumed(site: Site) -> None:
    await site.api("POST", "/users", {"name": "anna", "password": "one"}, status=201)
    anna = await site.login("anna", "one")
    await site.api("POST", "/containers", {"tag": "first"}, status=204)
    await site.api("POST", "/containers", {"tag": "mine"}, token=anna, status=204)
    everything = await read_events(site, 3, site.token, since=0)
    assert [e["subject"] for e in everything] == ["testUser", "anna", "testUser/first"]
    assert [e["subject"] for e in await read_events(site, 1, anna, since=0)] == ["anna/mine"]
    resumed = await read_events(site, 1, site.token, last=everything[-1]["id"])
    assert [e["subject"] for e in resumed] == ["anna/mine"]
    waiting = asyncio.ensure_future(read_events(site, 1, site.token, last=resumed[0]["id"]))
    await site.api("DELETE", "/containers/first", status=204)
    assert [e["kind"] for e in await waiting] == ["container_destroyed"]
    late = await read_events(site, 4, site.token, last=5)
    assert [e["kind"] for e in late[:2]] == ["gap", "user_added"]
    assert 5 < late[0]["id"] < late[1]["id"] == everything[0]["id"]
    assert late[1:] == everything


async def test_a_stream_names_the_id_after_which_it_begins(site: Site) -> None:
    await site.api("POST", "/users", {"name": "anna", "password": "one"}, status=201)
    newest = (await read_events(site, 2, site.token, since=0))[-1]["id"]
    headers = {"Authorization": f"Bearer {site.token}"}
    async with site.session.get(f"{site.url}api/v1/events", headers=headers) as reply:
        assert await reply.content.readline() == b"id: %d\n" % newest


async def test_events_after_a_greater_id_begin_with_a_gap(site: Site) -> None:
    """A follower has an id of the time when the store was etcd; a stream and pages tell it the same."""
    await site.api("POST", "/users", {"name": "anna", "password": "one"}, status=201)
    everything = await read_events(site, 2, site.token, since=0)
    former = 10_010_000_000_007
    gap, *events = await read_events(site, 3, site.token, last=former)
    assert gap["kind"] == "gap"
    assert gap["id"] < everything[0]["id"]
    assert events == everything
    headers = {"Authorization": f"Bearer {site.token}", "Accept": "application/json"}
    found, since = [], former
    for _ in range(4):
        query = {"since": since, "limit": 1}
        async with site.session.get(f"{site.url}api/v1/events", headers=headers, params=query) as reply:
            page = await reply.json()
        found += page["events"]
        since = int(page["next"] or page["newest"])
    assert [(event["kind"], event["id"]) for event in found] == [
        (event["kind"], event["id"]) for event in (gap, *everything)
    ]
    assert since == everything[-1]["id"]


async def test_user_does_not_see_a_predecessors_records(site: Site) -> None:
    """A user does not see what one of the same name did before."""
    anna = {"name": "anna", "password": "one"}
    await site.api("POST", "/users", anna, status=201)
    await site.api(
        "POST", "/containers", {"tag": "former"}, token=await site.login("anna", "one"), status=204
    )
    await site.api("DELETE", "/users/anna", status=204)
    await site.api("POST", "/users", anna, status=201)
    token = await site.login("anna", "one")
    await site.api("POST", "/containers", {"tag": "mine"}, token=token, status=204)
    assert [e["subject"] for e in await read_events(site, 1, token, since=0)] == ["anna/mine"]


async def test_user_made_before_clock_went_back_sees_events(
    run_site: RunSite, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock, ahead = time.time, 86_400.0
    monkeypatch.setattr(time, "time", lambda: clock() + ahead)
    async with run_site() as site:
        await site.api("POST", "/users", {"name": "anna", "password": "one"}, status=201)
        ahead = 0.0
        anna = await site.login("anna", "one")
        await site.api("POST", "/containers", {"tag": "mine"}, token=anna, status=204)
        headers = {"Authorization": f"Bearer {anna}", "Accept": "application/json"}
        async with site.session.get(f"{site.url}api/v1/events", headers=headers) as reply:
            assert [event["subject"] for event in (await reply.json())["events"]] == ["anna/mine"]
        assert [e["subject"] for e in await read_events(site, 1, anna, since=0)] == ["anna/mine"]


async def test_a_stream_ends_with_the_token(site: Site) -> None:
    await site.api("POST", "/users", {"name": "anna", "password": "one"}, status=201)
    anna = await site.login("anna", "one")
    headers = {"Authorization": f"Bearer {anna}", "Last-Event-ID": "9" * 5000}
    async with site.session.get(f"{site.url}api/v1/events", headers=headers) as reply:
        assert (await reply.content.readline()).startswith(b"id: ")
        await site.api("PUT", "/users/anna/password", {"password": "two"}, status=204)
        await site.api("POST", "/containers", {"tag": "c"}, status=204, user="anna")
        rest = await reply.content.read()
        assert b"event: stream_ended" in rest
        assert rest.count(b"event: ") == 1, "what came after the end of the access"


async def test_the_document_describes_every_route(site: Site) -> None:
    document = await site.api("GET", "/openapi.json", token="")
    assert document["openapi"].startswith("3.1")
    paths = document["paths"]
    assert {"get", "post"} <= set(paths["/api/v1/containers"])
    assert paths["/api/v1/login"]["post"]["security"] == []
    references = [part.split('"')[0] for part in json.dumps(document).split('"#/components/schemas/')[1:]]
    assert set(references) <= set(document["components"]["schemas"])
    assert "requestBody" in paths["/api/v1/connections"]["post"]


async def test_a_master_that_ends_lets_go_of_streams(
    run_site: RunSite,
) -> None:
    async with run_site() as site:
        headers = {"Authorization": f"Bearer {site.token}"}
        reply = await site.session.get(f"{site.url}api/v1/events", headers=headers)
        assert (await reply.content.readline()).startswith(b"id: ")
        reply.close()
