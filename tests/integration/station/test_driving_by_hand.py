"""Driving a robot by hand over a WebSocket, in a real ROS graph."""

from __future__ import annotations

import asyncio
import contextlib
import json

import pytest
from aiohttp import ClientWebSocketResponse, WSCloseCode, WSMsgType
from support.controlled_robots import LIMIT_S, drive_until, driven_shortly, frame, site
from support.planner_states import robot, state

from rce_fleet.station.authentication import StationUser
from rce_fleet.station.commands import routes


async def test_a_robot_is_driven_while_the_switch_is_held() -> None:
    """It stops when the switch is released, when frames stop, and when the page leaves."""
    async with site() as made:
        async with made.client.ws_connect("/api/v1/robots/Robot1/drive") as page:
            assert (await frame(page, 0))["speed"] == 0.2
            await made.until(lambda: (0.2, 0.0) in made.velocities)
            assert made.fleet.modes == [("Robot1", "manual")]
            assert (await frame(page, 1, held=False))["reason"] == "the dead-man's switch is released"
            await made.until(lambda: made.velocities[-1] == (0.0, 0.0))
            await frame(page, 2)
            made.velocities.clear()
            await made.until(lambda: made.velocities and made.velocities[-1] == (0.0, 0.0))
            async with made.client.ws_connect("/api/v1/robots/Robot1/drive") as second:
                assert "is driven by" in json.loads(await second.receive_str(timeout=LIMIT_S))["error"]
        await made.until(lambda: made.fleet.modes[-1] == ("Robot1", "automatic"))
        await made.until(lambda: made.control.driven == {})


async def test_a_robot_that_is_away_is_not_shown_as_driven() -> None:
    """The answers to frames say so, whatever they ask for."""
    async with site() as made, made.client.ws_connect("/api/v1/robots/Robot1/drive") as page:
        assert (await frame(page, 0))["speed"] == 0.2
        assert made.motor is not None
        await made.motor.close()
        async with asyncio.timeout(LIMIT_S):
            for number in range(1, 1_000_000):
                answer = await frame(page, number)
                if answer["speed"] == 0.0:
                    break
                await asyncio.sleep(0.01)
        assert answer["reason"] == "the robot is not connected"


async def test_a_robot_whose_answers_fail_to_come_stands() -> None:
    """As behind a network with seconds of queue, which the page does not see by itself."""
    async with site() as made:
        made.answers = True
        async with made.client.ws_connect("/api/v1/robots/Robot1/drive") as page:
            await drive_until(page, lambda answer: answer["robot_round_trip"] and answer["speed"] == 0.2)
            made.answers = False
            stands = await drive_until(page, lambda answer: answer["speed"] == 0.0)
            assert "round trip to the robot" in stands["reason"]
            made.velocities.clear()
            await made.until(lambda: made.velocities and made.velocities[-1] == (0.0, 0.0))
            made.answers = True
            await drive_until(page, lambda answer: answer["speed"] == 0.2)


async def test_a_station_that_ends_gives_driven_robots_their_modes_back() -> None:
    """Before it closes the pages, which may be away; it lets no robot be driven any more."""
    async with site() as made, made.client.ws_connect("/api/v1/robots/Robot1/drive") as page:
        await frame(page, 0)
        await made.station.end_drives()
        assert made.fleet.modes == [("Robot1", "manual"), ("Robot1", "automatic")]
        assert (await page.receive(timeout=LIMIT_S)).data == WSCloseCode.GOING_AWAY
        await made.until(lambda: made.velocities[-1] == (0.0, 0.0))
        async with made.client.get("/api/v1/robots/Robot1/drive") as reply:
            assert reply.status == 503


async def test_a_robot_that_does_not_listen_is_not_driven() -> None:
    async with site() as made, made.client.ws_connect("/api/v1/robots/Robot2/drive") as page:
        assert "raw_cmd_vel" in json.loads(await page.receive_str(timeout=LIMIT_S))["error"]


@pytest.mark.parametrize("robot_id", ["Robot1", "Robot2"])
@pytest.mark.parametrize(
    ("mode", "fleet_mode", "own"),
    [
        ("out_of_service", "automatic", "out_of_service"),
        ("paused", "automatic", "paused"),
        ("paused", "paused", "automatic"),
        ("automatic", "automatic", "automatic"),
    ],
)
async def test_driving_gives_a_robot_its_own_mode_back(
    robot_id: str, mode: str, fleet_mode: str, own: str
) -> None:
    """Also if driving fails because the robot, as Robot2, does not listen."""
    async with site() as made:
        made.view.on_state(state(robot(robot_id, mode=mode), mode=fleet_mode))
        await driven_shortly(made, robot_id)
        assert made.fleet.modes == [(robot_id, "manual"), (robot_id, own)]


async def test_a_mode_that_is_set_while_driving_stays() -> None:
    async with site() as made:
        made.view.on_state(state(robot("Robot1", mode="automatic")))
        async with made.client.ws_connect("/api/v1/robots/Robot1/drive") as page:
            await frame(page, 0)
            made.view.on_state(state(robot("Robot1", mode="out_of_service")))
        await made.until(lambda: not made.control.driven)
        assert made.fleet.modes == [("Robot1", "manual")]


async def _drive_to_the_end(page: ClientWebSocketResponse) -> list[str]:
    """Send frames until the station closes the drive; return the reasons and errors that it told."""
    told = []
    async with asyncio.timeout(LIMIT_S):
        for number in range(1, 1_000_000):
            frame = {"number": number, "sent": asyncio.get_running_loop().time(), "held": True}
            with contextlib.suppress(ConnectionError):  # the station has closed it: read on
                await page.send_str(json.dumps({**frame, "speed": 0.2}))
            message = await page.receive()
            if message.type is not WSMsgType.TEXT:
                break
            answer = json.loads(message.data)
            told.append(answer.get("reason") or answer.get("error", ""))
            await asyncio.sleep(0.01)
    return told


@pytest.mark.parametrize("mode", ["automatic", "paused"])
async def test_driving_ends_when_another_mode_is_set(mode: str) -> None:
    """As when another operator resumes the robot: the planner would drive it, too."""
    async with site() as made:
        made.view.on_state(state(robot("Robot1", mode="automatic")))
        async with made.client.ws_connect("/api/v1/robots/Robot1/drive") as page:
            await frame(page, 0)
            made.fleet.show("Robot1", mode)
            told = await _drive_to_the_end(page)
        assert f"Robot1 is {mode} now" in told[-1]
        await made.until(lambda: not made.control.driven)
        await made.until(lambda: made.velocities and made.velocities[-1] == (0.0, 0.0))
        assert made.view.mode_of("Robot1") == mode


async def test_a_restarted_planner_gets_the_mode_manual_again() -> None:
    """The robot stands until the planner, which begins with automatic, has accepted it."""
    async with site() as made:
        made.view.on_state(state(robot("Robot1", mode="paused")))
        async with made.client.ws_connect("/api/v1/robots/Robot1/drive") as page:
            await frame(page, 0)
            made.fleet.refuses.add("manual")
            made.fleet.show("Robot1", "automatic", run="2")
            await made.until(lambda: made.velocities and made.velocities[-1] == (0.0, 0.0))
            assert "was restarted" in (await frame(page, 1))["reason"]
            made.fleet.run = "2"
            made.fleet.refuses.clear()
            await made.until(lambda: len(made.fleet.modes) > 1)
            assert made.fleet.modes == [("Robot1", "manual")] * 2
            assert (await frame(page, 2))["speed"] == 0.2
        await made.until(lambda: not made.control.driven)
        assert made.fleet.modes[-1] == ("Robot1", "paused")


async def test_a_robot_whose_manual_mode_is_refused_keeps_its_mode() -> None:
    async with site() as made:
        made.fleet.refuses.add("manual")
        async with made.client.ws_connect("/api/v1/robots/Robot1/drive") as page:
            assert "is refused" in json.loads(await page.receive_str(timeout=LIMIT_S))["error"]
        await made.until(lambda: not made.control.driven)
        assert (made.fleet.modes, made.fleet.events) == ([], [])


async def test_a_mode_that_cannot_be_restored_is_told_and_tried_again() -> None:
    async with site() as made:
        made.view.on_state(state(robot("Robot1", mode="paused")))
        made.fleet.refuses.add("paused")
        await driven_shortly(made, "Robot1")
        assert ["stays manual; it was paused before" in text for text in made.fleet.events] == [True]
        made.view.on_state(state(robot("Robot1", mode="manual")))
        made.fleet.refuses.clear()
        await driven_shortly(made, "Robot1")
        assert made.fleet.modes[-1] == ("Robot1", "paused")


async def test_a_robot_is_driven_again_only_after_its_mode_is_restored() -> None:
    """The late request of the one who drove before would end the mode of the next one."""
    async with site() as made:
        made.fleet.may_restore.clear()
        async with made.client.ws_connect("/api/v1/robots/Robot1/drive") as page:
            await frame(page, 0)
        await made.until(lambda: ("Robot1", "automatic") in made.fleet.modes)
        async with made.client.ws_connect("/api/v1/robots/Robot1/drive") as second:
            assert "is driven by" in json.loads(await second.receive_str(timeout=LIMIT_S))["error"]
        made.fleet.may_restore.set()
        await made.until(lambda: not made.control.driven)
        await driven_shortly(made, "Robot1")
        assert [mode for _, mode in made.fleet.modes] == ["manual", "automatic"] * 2


@pytest.mark.parametrize("user", [None, StationUser("operator", "viewer")])
async def test_driving_ends_with_the_permission(
    user: StationUser | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """When the login is revoked, or the role is taken away; the page still sends frames."""
    monkeypatch.setattr(routes, "CHECK_S", 0.05)
    async with site() as made, made.client.ws_connect("/api/v1/robots/Robot1/drive") as page:
        assert (await frame(page, 0))["speed"] == 0.2
        made.login.user = user
        await _drive_to_the_end(page)
        assert page.close_code == WSCloseCode.POLICY_VIOLATION
        await made.until(lambda: not made.control.driven)
        await made.until(lambda: made.velocities and made.velocities[-1] == (0.0, 0.0))
        assert made.fleet.modes[-1] == ("Robot1", "automatic")
