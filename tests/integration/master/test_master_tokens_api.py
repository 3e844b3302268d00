"""Tokens over the REST API: listed, limited, revoked; what they opened ends."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from rce_master.state.settings import StateSettings

if TYPE_CHECKING:
    from integration.master.conftest import RunSite, Site


async def test_tokens_are_listed_without_their_text(site: Site) -> None:
    await site.login()
    listed = (await site.api("GET", "/tokens"))["tokens"]
    assert [token["current"] for token in listed] == [True, False]
    assert listed[0]["used"] > 0
    assert listed[1]["used"] == 0
    assert listed[0]["expires"] > listed[0]["created"]
    assert site.token not in str(listed)


async def test_revoked_token_ends_its_streams_with_reason(site: Site) -> None:
    """Event streams and usage streams end at once, and say why."""
    other = await site.login()
    (other_id,) = [t["id"] for t in (await site.api("GET", "/tokens"))["tokens"] if not t["current"]]
    headers = {"Authorization": f"Bearer {other}"}
    async with (
        site.session.get(f"{site.url}api/v1/events", headers=headers) as events,
        site.session.get(f"{site.url}api/v1/usage/live?interval=3600", headers=headers) as usage,
    ):
        await events.content.readuntil(b"hello\n\n")
        await usage.content.readuntil(b"\n\n")
        await site.api("DELETE", f"/tokens/{other_id}", status=204)
        async with asyncio.timeout(60):
            said = await events.content.read(), await usage.content.read()
    assert b"event: stream_ended" in said[0]
    assert b"revoked or expired" in said[0]
    assert b"revoked or expired" in said[1]
    await site.api("GET", "/user", token=other, status=401)
    await site.api("DELETE", f"/tokens/{other_id}", status=404)


async def test_many_logins_keep_the_number_of_tokens_bounded(
    run_site: RunSite,
) -> None:
    async with run_site(state=StateSettings(max_tokens=5)) as site:
        for _ in range(20):
            await site.login()
            await site.api("GET", "/user")  # the one that is in use is never pushed out
        assert len((await site.api("GET", "/tokens"))["tokens"]) == 5


async def test_robot_token_is_not_for_the_api(site: Site) -> None:
    made = await site.api("POST", "/robot-tokens", {"robot": "R1"}, status=201)
    refusal = await site.api("GET", "/user", token=made["token"], status=403)
    assert "good for robot 'R1' only" in refusal["error"]
    assert (await site.api("GET", "/robot-tokens"))["tokens"][0]["robot"] == "R1"
    await site.api("POST", "/robot-tokens", {"robot": "no name"}, status=422)
    await site.api("DELETE", "/robot-tokens/R1", status=204)
    await site.api("GET", "/user", token=made["token"], status=401)


async def test_users_see_and_revoke_their_own_tokens_only(site: Site) -> None:
    await site.api("POST", "/users", {"name": "anna", "password": "one"}, status=201)
    anna = await site.login("anna", "one")
    (own,) = (await site.api("GET", "/tokens", user="testUser"))["tokens"]
    await site.api("GET", "/tokens", token=anna, status=403, user="testUser")
    await site.api("DELETE", f"/tokens/{own['id']}", token=anna, status=404)
    await site.api("POST", "/tokens", {"scope": "metrics"}, token=anna, status=403)
    assert len((await site.api("GET", "/tokens", user="anna"))["tokens"]) == 1


async def test_a_fleet_token_is_for_stations_only(site: Site) -> None:
    """A station may ask whose it is, and note what its user did; the engine refuses it for all else."""
    await site.api("POST", "/users", {"name": "erp", "password": "one", "role": "operator"}, status=201)
    made = await site.api("POST", "/tokens", {"scope": "fleet", "label": "hall 3"}, status=201, user="erp")
    assert (made["userID"], made["scope"], made["expires"]) == ("erp", "fleet", 0)
    token = made["token"]
    assert (await site.api("GET", "/user", token=token))["role"] == "operator"
    noted = {"action": "create_task", "subject": "T1", "detail": "", "address": "", "outcome": "done"}
    await site.api("POST", "/audit", noted, token=token, status=204)
    refusal = await site.api("GET", "/containers", token=token, status=403)
    assert "good for operator stations only" in refusal["error"]
    await site.api("POST", "/tokens", {"scope": "fleet"}, token=token, status=403)
    erp = await site.login("erp", "one")
    assert (await site.api("POST", "/tokens", {"scope": "fleet"}, token=erp, status=201))["userID"] == "erp"
    await site.api("POST", "/tokens", {"scope": "fleet"}, token=erp, status=403, user="testUser")
    await site.api("DELETE", f"/tokens/{made['id']}", status=204, user="erp")
    await site.api("GET", "/user", token=token, status=401)
