"""What each role may do over the REST API, and what of it the audit log tells."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import pytest

from rce.control import Execute
from rce.control.execution import FEATURE
from rce.control.messages import TaskSetKind
from rce_master.auth import client_digest

if TYPE_CHECKING:
    from pathlib import Path

    from integration.master.conftest import RunSite, Site


async def make_users(site: Site) -> dict[str, str]:
    """One user of each role; returns a token of each."""
    tokens = {}
    for role in ("viewer", "user", "operator", "admin"):
        body = {"name": role, "password": "pw", "role": role}
        assert (await site.api("POST", "/users", body, status=201))["role"] == role
        tokens[role] = await site.login(role, "pw")
    return tokens


async def test_roles_see_and_change(site: Site) -> None:
    tokens = await make_users(site)
    await site.api("POST", "/containers", {"tag": "c"}, status=204)
    seen = {
        role: len((await site.api("GET", "/containers", token=token))["containers"])
        for role, token in tokens.items()
    }
    assert seen == {"viewer": 1, "user": 0, "operator": 1, "admin": 1}
    for role, status in (("viewer", 403), ("user", 204), ("operator", 204), ("admin", 204)):
        await site.api("POST", "/containers", {"tag": "own"}, token=tokens[role], status=status)
    for role, status in (("viewer", 403), ("user", 403), ("operator", 403), ("admin", 204)):
        await site.api("DELETE", "/containers/c", token=tokens[role], status=status, user="testUser")
    for role in ("viewer", "user", "operator"):
        await site.api("GET", "/users", token=tokens[role], status=403)
        await site.api("GET", "/audit", token=tokens[role], status=403)
        await site.api("GET", "/tokens", token=tokens[role], status=403, user="testUser")
    await site.api("POST", "/robot-tokens", {"robot": "R"}, token=tokens["viewer"], status=403)
    passwords = {"password": "new", "old_password": "pw"}
    await site.api("PUT", "/users/viewer/password", passwords, token=tokens["viewer"], status=204)


async def test_role_changes_at_once_and_last_admin_stays(site: Site) -> None:
    tokens = await make_users(site)
    async with site.robots() as robots:
        right = client_digest("pw")
        assert (await robots.channel.login("viewer", "rob", right)).status == 403
        assert (await robots.channel.login("user", "rob", right)).status == 200
        await site.api("PUT", "/users/user/role", {"role": "viewer"}, status=204)
        refused = await robots.channel.login("user", "rob", right)
        assert (refused.status, "connects no robots" in refused.reason) == (403, True)
    await site.api("POST", "/containers", {"tag": "x"}, token=tokens["user"], status=403)
    await site.api("PUT", "/users/admin/role", {"role": "user"}, status=204)
    await site.api("PUT", "/users/testUser/role", {"role": "user"}, status=409)
    await site.api("PUT", "/users/anna/role", {"role": "user"}, status=404)
    await site.api("PUT", "/users/user/role", {"role": "king"}, status=422)


async def test_audit_tells_who_did_what_without_secrets(run_site: RunSite, tmp_path: Path) -> None:
    async with run_site(state_dir=tmp_path) as site:
        tokens = await make_users(site)
        await site.api("POST", "/login", {"userID": "user", "password": "hunter22"}, token="", status=401)
        await site.api("POST", "/login", {"userID": "hunter33", "password": "x"}, token="", status=401)
        await site.api("POST", "/containers", {"tag": "c"}, token=tokens["user"], status=204)
        parameter = {"name": "key", "value": "hunter44"}
        await site.api("PUT", "/containers/c/parameters", parameter, token=tokens["user"], status=204)
        await site.api("POST", "/containers", {"tag": "c"}, token=tokens["viewer"], status=403)
        robot = await site.api("POST", "/robot-tokens", {"robot": "R1"}, token=tokens["user"], status=201)
        await site.api("DELETE", f"/tokens/{tokens['admin']}", token=tokens["user"], status=404)
        noted = {"action": "set_goal", "subject": "R1", "detail": "cell 7", "address": "192.0.2.7"}
        await site.api("POST", "/audit", noted, token=tokens["operator"], status=204)
        async with site.robots() as robots:
            assert (await robots.channel.login("user", "R1", "", token=robot["token"])).status == 200
            assert (await robots.channel.login("user", "R2", client_digest("hunter55"))).status == 401
            await robots.channel.client_request("user/R1", "DC", {"containerTag": "c"})
        records = (await site.api("GET", "/audit", since=-1000))["records"]
        told = [(r["user"], r["action"], r["outcome"]) for r in records]
        for expected in (
            ("testUser", "add_user", "done"),
            ("user", "log_in", "done"),
            ("user", "log_in", "refused"),
            ("", "log_in", "refused"),
            ("user", "create_container", "done"),
            ("user", "set_parameter", "done"),
            ("viewer", "create_container", "refused"),
            ("user", "add_robot_token", "done"),
            ("operator", "set_goal", "done"),
            ("user", "connect_robot", "done"),
            ("user", "connect_robot", "refused"),
            ("user", "request_dc", "done"),
        ):
            assert expected in told, told
        (steered,) = [r for r in records if r["action"] == "set_goal"]
        assert (steered["via"], steered["detail"], steered["address"]) == ("station", "cell 7", "127.0.0.1")
        assert steered["client"] == "192.0.2.7", "it is what the caller told"
        only = (await site.api("GET", "/audit", since=-1000, user="viewer"))["records"]
        assert {r["user"] for r in only} == {"viewer"}
    text = (tmp_path / "audit" / "audit.jsonl").read_text()
    assert len([json.loads(line) for line in text.splitlines()]) >= len(records)
    secrets = ("hunter", client_digest("hunter55"), robot["token"], *tokens.values(), client_digest("pw"))
    assert [secret for secret in secrets if secret in text] == []


async def test_viewer_notes_nothing_as_done(site: Site) -> None:
    tokens = await make_users(site)
    await site.api("POST", "/audit", {"action": "set_goal"}, token=tokens["viewer"], status=403)
    refused = {"action": "set_goal", "outcome": "refused"}
    await site.api("POST", "/audit", refused, token=tokens["viewer"], status=204)
    await site.api("POST", "/audit", {"action": "Set goal"}, token=tokens["operator"], status=422)


async def test_audit_has_refused_tokens(site: Site) -> None:
    """A token that was guessed, revoked, or made for something else."""
    tokens = await make_users(site)
    robot = await site.api("POST", "/robot-tokens", {"robot": "R1"}, token=tokens["user"], status=201)
    await site.api("GET", "/containers", token="rce_guess", status=401)
    await site.api("POST", "/containers", {"tag": "c"}, token=robot["token"], status=403)
    for token, status in (("rce_guess", 401), (robot["token"], 403)):
        headers = {"Authorization": f"Bearer {token}"}
        async with site.session.get(f"{site.url}metrics", headers=headers) as reply:
            assert reply.status == status
    records = (await site.api("GET", "/audit", since=-1000))["records"]
    told = [(r["user"], r["action"]) for r in records if r["outcome"] == "refused"]
    assert told == [
        ("", "list_containers"), ("user", "create_container"), ("", "get_metrics"), ("user", "get_metrics")
    ]  # fmt: skip


async def test_audit_has_refused_robot_request(site: Site) -> None:
    async with site.robots() as robots:
        assert (await robots.channel.login("testUser", "R1", client_digest("testUser"))).status == 200
        await robots.channel.client_request("testUser/R1", "CC", {"containerTag": "c"})
        await robots.channel.client_request("testUser/R1", "DC", {"containerTag": "d"})
        two = {"removeNodes": [{"containerTag": tag, "nodeTag": "n"} for tag in ("c", "d")]}
        await robots.channel.client_request("testUser/R1", "CN", two)
    records = (await site.api("GET", "/audit", since=-1000))["records"]
    told = [(r["action"], r["outcome"], r["via"]) for r in records if r["action"].startswith("request_")]
    assert told == [
        ("request_cc", "done", "testUser/R1"),
        ("request_dc", "refused", "testUser/R1"),
        ("request_cn", "refused", "testUser/R1"),
    ]


async def run_command(site: Site, token: str, end_login: bool) -> bytes:
    """Send a command late on the WebSocket of a run; return the frame that ends it."""
    url, headers = f"{site.url}api/v1/containers/c/exec", {"Authorization": f"Bearer {token}"}
    async with site.session.ws_connect(url, params={"user": "testUser"}, headers=headers) as socket:
        if end_login:
            await site.api("PUT", "/users/admin/role", {"role": "user"}, status=204)
        await socket.send_str('{"argv": ["touch", "hunter22"]}')
        return await socket.receive_bytes()


async def test_audit_has_only_commands_that_ran(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rce_master.executions.DIAL_S", 0.1)
    tokens = await make_users(site)
    async with site.task_set(TaskSetKind.CONTAINER, "c1", features=(FEATURE,)) as containers:
        await site.api("POST", "/containers", {"tag": "c"}, status=204)
        assert b"does not answer" in await run_command(site, tokens["admin"], end_login=False)
        await containers.get(Execute)
        assert b"login has ended" in await run_command(site, tokens["admin"], end_login=True)
        assert b"does not answer" in await run_command(site, site.token, end_login=False)
        assert [type(one) for one in containers.taken].count(Execute) == 1
        await containers.get(Execute)
        assert containers.inbox.empty(), "the machine never gets the command of a login that has ended"
    records = (await site.api("GET", "/audit", since=-1000))["records"]
    told = [(r["user"], r["outcome"], r["detail"]) for r in records if r["action"] == "execute"]
    away = "program touch: the machine of container 'c' does not answer"
    assert told == [
        ("admin", "refused", away),
        ("admin", "refused", "program touch: your login has ended"),
        ("testUser", "refused", away),
    ]
