"""Lists of the REST API page by page: all items once, also while the state changes."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import pytest

from rce.packages.signing import SigningKey
from rce_master.cli.client import ApiClient
from rce_master.cli.show import fetch

if TYPE_CHECKING:
    from integration.master.conftest import Site

TAGS = [f"c{number}" for number in range(7)]


@pytest.fixture
async def filled(site: Site) -> Site:
    """A site with two users, whose containers have nodes, parameters and interfaces."""
    await site.api("POST", "/users", {"name": "anna_b", "password": "x"}, status=201)
    await site.api("POST", "/users", {"name": "anna", "password": "x"}, status=201)
    for user in ("anna_b", "testUser", "anna"):
        query = f"?user={user}"
        for tag in TAGS:
            await site.api("POST", f"/containers{query}", {"tag": tag}, status=204)
        for name in ("n2", "n1", "n3"):
            body = {"tag": name, "pkg": "p", "exe": "e"}
            await site.api("POST", f"/containers/c1/nodes{query}", body, status=204)
            value = {"name": name, "value": "1"}
            await site.api("PUT", f"/containers/c3/parameters{query}", value, status=204)
            for end, role in (("c1", "Publisher"), ("c2", "Subscriber")):
                body = {"tag": name, "type": f"{role}Interface", "cls": "std_msgs/String", "addr": f"/{name}"}
                await site.api("POST", f"/endpoints/{end}/interfaces{query}", body, status=204)
            body = {"tag_a": f"c1/{name}", "tag_b": f"c2/{name}"}
            await site.api("POST", f"/connections{query}", body, status=204)
    return site


async def pages(site: Site, path: str, limit: int, name: str = "") -> list[list[dict[str, Any]]]:
    name = name or path.partition("?")[0].strip("/")
    found, cursor = [], ""
    while True:
        mark = "&" if "?" in path else "?"
        page = await site.api("GET", f"{path}{mark}limit={limit}" + (f"&cursor={cursor}" if cursor else ""))
        found.append(page[name])
        assert len(page[name]) <= limit
        if page["next"] is None:
            return found
        assert len(page[name]) == limit, "only the last page is short"
        cursor = page["next"]


def sorted_(items: list[dict[str, Any]]) -> list[str]:
    return sorted(json.dumps(item, sort_keys=True) for item in items)


@pytest.mark.parametrize("limit", [1, 3, 1000])
async def test_tokens_and_keys_have_pages(site: Site, limit: int) -> None:
    for number in range(7):
        await site.api("POST", "/robot-tokens", {"robot": f"r{number}"}, status=201)
        await site.api("POST", "/package-keys", {"key": SigningKey.generate().public}, status=201)
    for path, name, count in (
        ("/tokens", "tokens", 8),
        ("/robot-tokens", "tokens", 7),
        ("/package-keys", "keys", 7),
    ):
        whole = await site.api("GET", path)
        assert whole["next"] is None
        assert len(whole[name]) == count
        found = [item for page in await pages(site, path, limit, name) for item in page]
        assert sorted(one["id"] for one in found) == sorted(one["id"] for one in whole[name])
    created = [token["created"] for token in (await site.api("GET", "/tokens"))["tokens"]]
    assert created == sorted(created)


@pytest.mark.parametrize("limit", [1, 3, 1000])
async def test_pages_add_up_to_the_whole_list(filled: Site, limit: int) -> None:
    async with filled.containers(), filled.robots():
        for kind in ("containers", "nodes", "parameters", "interfaces", "connections", "machines", "users"):
            whole = await filled.api("GET", f"/{kind}")
            assert whole["next"] is None
            found = [item for page in await pages(filled, f"/{kind}", limit) for item in page]
            assert sorted_(found) == sorted_(whole[kind]), kind
            assert whole[kind], kind
        only = [c for page in await pages(filled, "/containers?user=anna", limit) for c in page]
        assert [container["tag"] for container in only] == TAGS


async def test_pages_are_in_the_order_of_users_and_tags(filled: Site) -> None:
    ids = [c["id"] for page in await pages(filled, "/containers", 4) for c in page]
    assert ids == [f"{user}/{tag}" for user in ("anna", "anna_b", "testUser") for tag in TAGS]


async def test_items_that_stay_are_on_one_page_while_others_change(filled: Site) -> None:
    query = "/containers?user=anna&limit=3"
    first = await filled.api("GET", query)
    await filled.api("DELETE", "/containers/c2?user=anna", status=204)  # where the next page begins
    await filled.api("POST", "/containers?user=anna", {"tag": "c11"}, status=204)
    await filled.api("POST", "/containers?user=anna", {"tag": "c33"}, status=204)
    second = await filled.api("GET", f"{query}&cursor={first['next']}")
    assert [c["tag"] for c in first["containers"]] == ["c0", "c1", "c2"]
    assert [c["tag"] for c in second["containers"]] == ["c3", "c33", "c4"]


async def test_wrong_pages_are_refused(site: Site) -> None:
    for query, text in (
        ("limit=0", "'limit' must be 1 to 1000"),
        ("limit=1001", "'limit' must be 1 to 1000"),
        ("limit=many", "'limit' must be a whole number"),
        ("cursor=x", "'cursor' is not one that an answer contained"),
        ("cursor=WyJhIl0", "'cursor' is not one that an answer contained"),
    ):
        assert text in (await site.api("GET", f"/containers?{query}", status=422))["error"]


async def test_usage_has_machines_on_its_first_page(filled: Site) -> None:
    async with filled.containers():
        first = await filled.api("GET", "/usage?limit=10")
        second = await filled.api("GET", f"/usage?limit=1000&cursor={first['next']}")
        assert (len(first["machines"]), len(second["machines"])) == (1, 0)
        assert len(first["containers"]) + len(second["containers"]) == 3 * len(TAGS)


async def test_events_are_read_page_by_page(filled: Site) -> None:
    found, since = [], 0
    headers = {"Authorization": f"Bearer {filled.token}", "Accept": "application/json"}
    while True:
        url = f"{filled.url}api/v1/events?user=anna&since={since}&limit=4"
        async with filled.session.get(url, headers=headers) as reply:
            page = await reply.json()
        found += page["events"]
        if page["next"] is None:
            break
        since = int(page["next"])
    requested = [event["subject"] for event in found if event["kind"] == "container_requested"]
    assert requested == [f"anna/{tag}" for tag in TAGS]
    assert page["newest"] >= found[-1]["id"]


async def test_commands_follow_pages(filled: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rce_master.cli.client.PAGE_ITEMS", 2)
    async with ApiClient(filled.url, filled.token) as client:
        found = await fetch(client, "containers", "nodes", "robots")
        assert len(found["containers"]) == 3 * len(TAGS)
        assert len(found["nodes"]) == 9
        first, used = await client.pages("/usage", "containers")
        assert len(used) == 3 * len(TAGS)
        assert "machines" in first


async def test_a_query_parameter_that_a_route_does_not_have_is_named(site: Site) -> None:
    for method, path, known in (
        ("GET", "/containers?machine=m1", "cursor, limit, user"),
        ("DELETE", "/containers/c1?force=1&user=testUser", "user"),
        ("GET", "/users?user=testUser", "cursor, limit"),
        ("GET", "/masters?limit=1", "none"),
    ):
        answer = await site.api(method, path, status=422)
        assert "is unknown here" in answer["error"]
        assert answer["error"].endswith(f"known are: {known}")
    answer = await site.api("GET", "/containers?user=yan&user=testUser", status=422)
    assert answer["error"] == "query parameter 'user' is given 2 times; give it once"
    described = (await site.api("GET", "/openapi.json"))["paths"]
    assert "422" in described["/api/v1/masters"]["get"]["responses"]
