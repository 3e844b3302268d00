"""Robots with credentials of their own; what ends with them; and no credential in any program's output."""

from __future__ import annotations

import asyncio
import hashlib
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import aiohttp
import pytest
from support.engine import Engine, Program, until
from websockets.asyncio.client import connect
from websockets.exceptions import ConnectionClosed, InvalidStatus

from rce_client.connection import Connection, State
from rce_client.exceptions import RefusedError

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

pytestmark = [pytest.mark.e2e, pytest.mark.timeout(300)]

PASSWORD = "correct horse 7391"
DIGEST = hashlib.sha256(PASSWORD.encode()).hexdigest()
SECRET = "a secret for the tests"


class Site:
    """An engine that logs all it can, with the user ``anna``."""

    def __init__(self, engine: Engine, session: aiohttp.ClientSession) -> None:
        self.engine = engine
        self.session = session
        self.said: dict[str, list[str]] = {}

    async def api(self, method: str, path: str, body: object = None, status: int = 204) -> Any:
        headers = {"Authorization": f"Bearer {self.engine.token()}"}
        url = f"{self.engine.url}api/v1{path}"
        async with self.session.request(method, url, json=body, headers=headers) as reply:
            text = await reply.text()
            assert reply.status == status, text
            return json.loads(text) if text else None

    async def robot_token(self, robot: str) -> str:
        made = await self.api("POST", "/robot-tokens?user=anna", {"robot": robot}, 201)
        return str(made["token"])

    def robot(self, robot: str, password: str = "", token: str = "") -> Connection:
        said = self.said.setdefault(robot, [])

        def on_state(state: State, words: str) -> None:
            said.append(f"{state.value}: {words}")

        return Connection(self.engine.url, "anna", password, robot, token=token, on_state=on_state)

    @property
    def ws_url(self) -> str:
        return f"ws://127.0.0.1:{self.engine.robot_ports[0][0]}/"


@pytest.fixture
async def site(tmp_path: Path) -> AsyncIterator[Site]:
    engine = Engine(tmp_path)
    engine.master.argv += ["--log-level", "debug"]
    for task_set in (*engine.robots, engine.container):
        task_set.argv.append("-v")
    try:
        await engine.start()
        async with aiohttp.ClientSession() as session:
            made = Site(engine, session)
            await made.api("POST", "/users", {"name": "anna", "password": PASSWORD}, 201)
            yield made
    finally:
        await engine.stop()


async def test_token_is_good_for_its_robot_until_revoked(site: Site) -> None:
    token = await site.robot_token("R1")
    with pytest.raises(RefusedError, match="good for another robot"):
        async with site.robot("R2", token=token):
            pass
    with pytest.raises(RefusedError, match="not for robots"):
        async with site.robot("R1", token=site.engine.token()):
            pass
    async with site.robot("R1", token=token) as robot, site.robot("R3", PASSWORD) as other:
        await robot.create_container("c1")
        await site.api("DELETE", "/robot-tokens/R1?user=anna")
        async with asyncio.timeout(60):
            with pytest.raises(RefusedError, match="unknown or expired token"):
                await robot.wait_refused()
        assert other.connected
    assert "lost: the robot's token was revoked" in site.said["R1"]


async def test_changed_password_ends_its_sessions_with_reason(site: Site) -> None:
    token = await site.robot_token("R1")
    old = f"{site.ws_url}?userID=anna&robotID=R2&password={DIGEST}"
    async with (
        site.robot("R1", token=token) as robot,
        connect(old, proxy=None) as raw,  # as clients of earlier releases come
    ):
        await site.api("PUT", "/users/anna/password", {"password": "another one"})
        async with asyncio.timeout(60):
            with pytest.raises(ConnectionClosed) as closed:
                await raw.recv()
        assert closed.value.rcvd is not None
        assert (closed.value.rcvd.code, closed.value.rcvd.reason) == (1008, "the password was changed")
        with pytest.raises(InvalidStatus, match="401"):
            await connect(old, proxy=None)
        assert robot.connected, "a robot's own token outlasts the password"


async def test_no_output_holds_a_credential(site: Site, tmp_path: Path) -> None:
    """All programs at their highest level of logging, with right and wrong credentials."""
    token = await site.robot_token("R1")
    wrong = "rce_" + "w" * 43
    core = Program(
        "core", [str(Path(sys.executable).parent / "rce"), "core", "--port", "0"], site.engine.env, tmp_path
    )
    await core.start()
    uri = core.output().split("ROS_MASTER_URI=")[1].split()[0]
    bridges = []
    for robot, credential in (
        ("R1", {"token": token}),
        ("R2", {"password": PASSWORD}),
        ("R3", {"password": f"wrong {PASSWORD}"}),
        ("R4", {"token": wrong}),
    ):
        file = tmp_path / f"{robot}.json"
        file.write_text(
            json.dumps({"url": site.engine.url, "userID": "anna", "robotID": robot, **credential})
        )
        argv = [str(Path(sys.executable).parent / "rce-ros"), str(file), "-v", "--ros-master-uri", uri]
        bridges.append(Program(f"rce-ros-{robot}", argv, site.engine.env, tmp_path))
    try:
        for bridge in bridges[:2]:
            await bridge.start(timeout=60)
        for bridge in bridges[2:]:
            with pytest.raises(AssertionError, match="ended with 1"):
                await bridge.start(timeout=60)
        async with connect(f"{site.ws_url}?userID=anna&robotID=R5&password={DIGEST}", proxy=None):
            pass
        with pytest.raises(InvalidStatus):
            await connect(f"{site.ws_url}?userID=anna&robotID=R5&password={DIGEST[::-1]}", proxy=None)
        login = {"userID": "anna", "password": f"wrong {PASSWORD}"}
        await site.api("POST", "/login", login, 401)
        await site.api("DELETE", "/robot-tokens/R1?user=anna")
        await until(lambda: not bridges[0].running, timeout=60, what="the revoked robot ends")
        assert "token was revoked" in bridges[0].output()
    finally:
        for program in (*bridges, core):
            if program.running:
                await program.stop()
    api_token = site.engine.token()
    await site.engine.stop()
    hidden = {
        "password": PASSWORD,
        "digest": DIGEST,
        "wrong digest": DIGEST[::-1],
        "digest of the wrong password": hashlib.sha256(f"wrong {PASSWORD}".encode()).hexdigest(),
        "robot's token": token,
        "wrong token": wrong,
        "API token": api_token,
        "secret": SECRET,
    }
    outputs = {path.name: path.read_text(errors="replace") for path in tmp_path.rglob("*.log")}
    assert any("DEBUG" in text for text in outputs.values()), "nothing was logged in detail"
    found = [(name, what) for name, text in outputs.items() for what in hidden if hidden[what] in text]
    assert not found
