"""``Idempotency-Key``: a POST that is repeated after a lost answer is done once."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

import pytest
from support.etcd import CuttingProxy
from support.master_cloud import FragileStore

from rce.packages.signing import SigningKey
from rce_master.cli.client import ApiClient
from rce_master.http.api import ROUTES
from rce_master.store import SqliteStore

if TYPE_CHECKING:
    from pathlib import Path

    from integration.master.conftest import RunSite, Site

INTERFACE = {"tag": "in", "type": "PublisherInterface", "cls": "std_msgs/String", "addr": "/in"}
OTHER = {"tag": "out", "type": "SubscriberInterface", "cls": "std_msgs/String", "addr": "/out"}
NODE = {"tag": "n", "pkg": "Test", "exe": "stringEcho.py"}
REQUESTS: dict[str, tuple[str, dict[str, Any]]] = {
    "/users": ("/users", {"name": "bert", "password": "a password"}),
    "/tokens": ("/tokens", {"scope": "fleet"}),
    "/robot-tokens": ("/robot-tokens", {"robot": "r1"}),
    "/package-keys": ("/package-keys", {"key": SigningKey.generate().public, "label": "l"}),
    "/containers": ("/containers", {"tag": "b"}),
    "/containers/{container}/nodes": ("/containers/a/nodes", NODE),
    "/endpoints/{endpoint}/interfaces": (
        "/endpoints/a/interfaces",
        {**INTERFACE, "tag": "new", "addr": "/n"},
    ),
    "/connections": ("/connections", {"tag_a": "a/in", "tag_b": "a/out"}),
}
UNKEYED = {
    "/login": "a login whose answer is lost ends by itself",
    "/audit": "the log is not part of the state",
}


async def post(
    site: Site, path: str, body: dict[str, Any], key: str, **query: str
) -> tuple[int, str, dict[str, str]]:
    headers = {"Authorization": f"Bearer {site.token}", "Idempotency-Key": key}
    url = f"{site.url}api/v1{path}"
    async with site.session.post(url, json=body, headers=headers, params=query) as reply:
        told = {
            name: reply.headers[name]
            for name in ("Idempotent-Replayed", "Retry-After")
            if name in reply.headers
        }
        return reply.status, await reply.text(), told


def test_every_post_has_a_key_or_a_reason() -> None:
    posts = {route.path: route.keyed for route in ROUTES if route.method == "POST"}
    assert {path for path, keyed in posts.items() if keyed} == set(REQUESTS)
    assert {path for path, keyed in posts.items() if not keyed} == set(UNKEYED)
    assert not any(route.keyed for route in ROUTES if route.method != "POST")


async def prepare(site: Site) -> None:
    await site.api("POST", "/containers", {"tag": "a", "wait": True}, status=204)
    for interface in (INTERFACE, OTHER):
        await site.api("POST", "/endpoints/a/interfaces", interface, status=204)


async def test_every_keyed_request_is_done_once(site: Site) -> None:
    async with site.containers():
        await prepare(site)
        for path, body in REQUESTS.values():
            status, first, told = await post(site, path, body, f"key of {path}")
            assert status in {201, 204}, first
            assert told == {}
            events = site.master.state_service.reverts, len(site.master.state_service.tables.tokens)
            again = await post(site, path, body, f'"key of {path}"')
            assert again == (status, first, {"Idempotent-Replayed": "true"})
            assert events == (site.master.state_service.reverts, len(site.master.state_service.tables.tokens))
            status, text, _ = await post(site, path, body, f"key of {path}", user="testUser")
            assert status == 422
            assert "was used for another request" in text or "'user' is unknown here" in text


async def test_key_of_another_body_is_refused(site: Site) -> None:
    assert (await post(site, "/robot-tokens", {"robot": "r1"}, "k"))[0] == 201
    status, text, _ = await post(site, "/robot-tokens", {"robot": "r2"}, "k")
    assert (status, "was used for another request" in text) == (422, True)
    assert [token["robot"] for token in (await site.api("GET", "/robot-tokens"))["tokens"]] == ["r1"]


async def test_the_repeated_token_is_the_same_and_works(site: Site) -> None:
    answers = [await post(site, "/robot-tokens", {"robot": "r1"}, "k") for _ in range(2)]
    assert answers[0][1] == answers[1][1]
    await site.api("POST", "/robot-tokens", {"robot": "r1"}, status=409)


async def test_refused_request_may_be_sent_again(site: Site) -> None:
    body = {"tag_a": "a/in", "tag_b": "a/out"}
    assert (await post(site, "/connections", body, "k"))[0] == 404
    async with site.containers():
        await prepare(site)
        assert (await post(site, "/connections", body, "k"))[0] == 204


async def test_bad_keys_are_refused(site: Site) -> None:
    status, text, _ = await post(site, "/tokens", {"scope": "fleet"}, "k" * 201)
    assert (status, "1 to 200 printable ASCII characters" in text) == (400, True)
    assert [token for token in (await site.api("GET", "/tokens"))["tokens"] if token["scope"]] == []


async def test_other_users_key_is_another_key(site: Site) -> None:
    await site.api("POST", "/users", {"name": "anna", "password": "one"}, status=201)
    status, mine, _ = await post(site, "/tokens", {"scope": "fleet"}, "k")
    site.token = await site.login("anna", "one")
    status, hers, told = await post(site, "/tokens", {"scope": "fleet"}, "k")
    assert (status, told) == (201, {})
    assert mine != hers


async def test_repeat_while_the_first_is_under_way(run_site: RunSite) -> None:
    store = FragileStore()
    async with run_site(store) as site:
        store.free.clear()
        first = asyncio.create_task(post(site, "/robot-tokens", {"robot": "r1"}, "k"))
        while not site.master.state_service.tables.answers:
            await asyncio.sleep(0)
        status, text, told = await post(site, "/robot-tokens", {"robot": "r1"}, "k")
        assert (status, "under way" in text, told) == (409, True, {"Retry-After": "1"})
        store.free.set()
        status, answer, _ = await first
        assert await post(site, "/robot-tokens", {"robot": "r1"}, "k") == (
            status,
            answer,
            {"Idempotent-Replayed": "true"},
        )


async def test_answer_that_cannot_be_stored_is_not_given_later(run_site: RunSite) -> None:
    store = FragileStore()
    async with run_site(store) as site:
        store.broken = True
        assert (await post(site, "/tokens", {"scope": "fleet"}, "k"))[0] == 503
        store.broken = False
        status, _, told = await post(site, "/tokens", {"scope": "fleet"}, "k")
        assert (status, told) == (201, {})


async def test_answers_outlive_the_master(run_site: RunSite, tmp_path: Path) -> None:
    answers = []
    token = ""
    for _ in range(2):
        store = await SqliteStore.open(tmp_path)
        try:
            async with run_site(store, log_in=not token) as site:
                token = site.token = token or site.token
                answers.append(await post(site, "/tokens", {"scope": "fleet"}, "k"))
        finally:
            await store.close()
    (first_status, first, _), (status, second, told) = answers
    assert (first_status, first, told) == (status, second, {"Idempotent-Replayed": "true"})


@pytest.mark.parametrize("lost", [1, 2])
async def test_rce_repeats_what_lost_its_answer(site: Site, lost: int) -> None:
    proxy = CuttingProxy(site.url.removeprefix("http://").rstrip("/"))
    async with proxy.running(), ApiClient(f"http://{proxy.endpoint}/", site.token) as client:
        proxy.cut("/robot-tokens", lost)
        made = await client.call("POST", "/robot-tokens", {"robot": "r1"})
        assert proxy.cuts == lost
        listed = (await client.call("GET", "/robot-tokens"))["tokens"]
    assert [token["id"] for token in listed] == [made["id"]]
