"""The engine on the operator's page: what containers use, and advice."""

from __future__ import annotations

import asyncio
import json
from collections import Counter
from typing import Any

import pytest
from aiohttp import web
from aiohttp.test_utils import TestServer
from support.browser import CHROMIUM

from rce_fleet.station import engine_watch
from rce_fleet.station.engine_watch import EngineWatch
from rce_fleet.station.fleet_link import FleetLink
from rce_fleet.station.live import Broadcast
from rce_fleet.station.masters_watch import MastersWatch
from rce_fleet.station.server import Station
from rce_fleet.station.view import FleetView

MB = 1 << 20
ADVICE = {
    "about": "too small",
    "text": "uses 95 MB of its 100 MB of memory",
    "command": "rce resize c --memory 150M",
}
USAGE = {
    "id": "op/c",
    "cpu": 0.25,
    "cpu_limit": 0.5,
    "memory": 95 * MB,
    "memory_limit": 100 * MB,
    "restarts": 2,
    "oom_kills": 0,
    "advice": [ADVICE],
    "processes": 4,
}
MACHINE = {
    "machine": "m1",
    "process": "c1",
    "connected": True,
    "draining": True,
    "containers": 2,
    "slots": 8,
    "promised_slots": 2,
    "cores": 4,
    "promised_cores": 1.5,
    "memory": 1000 * MB,
    "promised_memory": 250 * MB,
    "advice": [],
    "cpu": 0.1,
}
ANSWERS: dict[str, Any] = {
    "containers": {
        "containers": [
            {"id": "op/c", "tag": "c", "state": "degraded", "machine": "m1", "detail": "", "moving_to": ""},
            {"id": "op/d", "tag": "d", "state": "starting", "machine": "m1", "detail": "", "moving_to": "c2"},
        ]
    },
    "nodes": {"nodes": [{"container": "c", "tag": "n", "state": "waiting", "detail": "again in 2 s"}]},
    "connections": {"connections": []},
    "interfaces": {"interfaces": []},
    "usage": {"time": 0.0, "containers": [USAGE], "machines": [MACHINE]},
}


async def watched(before: str = "") -> dict[str, Any]:
    """What the station makes of a master's answers; another master may come before it."""

    async def answer(request: web.Request) -> web.Response:
        name = request.path.rpartition("/")[2]
        return web.json_response({"token": "t"} if name == "login" else ANSWERS[name])

    app = web.Application()
    app.router.add_route("*", "/api/v1/{name}", answer)
    seen: asyncio.Queue[dict[str, Any]] = asyncio.Queue()
    async with TestServer(app) as server:
        watch = asyncio.create_task(
            EngineWatch(f"{before},{server.make_url('/')}", "op", "x", on_state=seen.put_nowait).run()
        )
        try:
            async with asyncio.timeout(30):
                while "containers" not in (state := await seen.get()):
                    assert before, state
                return state
        finally:
            watch.cancel()
            await asyncio.gather(watch, return_exceptions=True)


async def test_what_containers_use_is_read_with_their_state() -> None:
    first, second = (await watched())["containers"]
    assert first["usage"] == {key: USAGE[key] for key in first["usage"]}
    assert first["advice"] == [ADVICE]
    assert (second["usage"], second["advice"]) == (None, [])
    (machine,) = (await watched())["machines"]
    assert machine == {key: value for key, value in MACHINE.items() if key != "cpu"}


async def test_lists_of_a_large_fleet_are_read_more_seldom(monkeypatch: pytest.MonkeyPatch) -> None:
    """16 000 connections were read each second, for as long as that took."""
    monkeypatch.setattr(engine_watch, "POLL_S", 0.01)
    asked: Counter[str] = Counter()

    async def answer(request: web.Request) -> web.Response:
        name = request.path.rpartition("/")[2]
        asked[name] += 1
        if name == "connections":
            await asyncio.sleep(0.05)
        return web.json_response({"token": "t"} if name == "login" else ANSWERS[name])

    app = web.Application()
    app.router.add_route("*", "/api/v1/{name}", answer)
    async with TestServer(app) as server:
        watch = asyncio.create_task(
            EngineWatch(str(server.make_url("/")), "op", "x", on_state=lambda _: None).run()
        )
        async with asyncio.timeout(30):
            while asked["connections"] < 2:
                await asyncio.sleep(0.01)
        watch.cancel()
        await asyncio.gather(watch, return_exceptions=True)
    assert asked["containers"] > asked["connections"] + 3


async def test_of_several_masters_one_that_answers_is_watched() -> None:
    assert (await watched(before="http://127.0.0.1:1/"))["containers"]


async def test_a_master_that_cannot_answer_is_left_for_another() -> None:
    """One that is cut off from the others answers 503 for as long as that lasts."""

    async def answer(_: web.Request) -> web.Response:
        return web.json_response({"error": "no master leads"}, status=503)

    app = web.Application()
    app.router.add_route("*", "/api/v1/{name}", answer)
    async with TestServer(app) as cut_off:
        assert (await watched(before=str(cut_off.make_url("/"))))["containers"]


@pytest.mark.parametrize("text", ["{}", "[]", "<html>", '{"token": "t", "containers": [{}]}'])
async def test_another_program_at_a_masters_address_is_left_too(text: str) -> None:
    """It ended the station, and with it the emergency stops."""

    async def answer(_: web.Request) -> web.Response:
        return web.Response(text=text, content_type="application/json")

    app = web.Application()
    app.router.add_route("*", "/api/v1/{name}", answer)
    async with TestServer(app) as stranger:
        assert (await watched(before=str(stranger.make_url("/"))))["containers"]


@pytest.mark.parametrize("text", ["[]", '{"role": "leader", "ready": true, "term": null}'])
async def test_another_program_does_not_end_the_watch_of_masters(text: str) -> None:
    async def answer(_: web.Request) -> web.Response:
        return web.Response(text=text, content_type="application/json")

    app = web.Application()
    app.router.add_get("/healthz", answer)
    seen: asyncio.Queue[dict[str, Any]] = asyncio.Queue()
    async with TestServer(app) as stranger:
        urls = f"http://127.0.0.1:1/,{stranger.make_url('/')}"
        watch = asyncio.create_task(MastersWatch(urls, on_state=seen.put_nowait).run())
        told = asyncio.create_task(seen.get())
        try:
            async with asyncio.timeout(30):
                await asyncio.wait({watch, told}, return_when=asyncio.FIRST_COMPLETED)
            assert not watch.done(), watch.exception()
            assert [master["role"] for master in (await told)["masters"]] == ["away", "away"]
        finally:
            for task in (watch, told):
                task.cancel()
            await asyncio.gather(watch, told, return_exceptions=True)


@pytest.mark.needs("chromium")
async def test_the_page_shows_bars_and_advice() -> None:
    from playwright.async_api import async_playwright

    pages = Broadcast()
    rates = [{"messages_s": 2.5, "bytes_s": 900}, {"messages_s": 40.0, "bytes_s": 51_000}]
    connections = [{"tag_a": f"a/{n}", "tag_b": f"b/{n}", "established": True, **rates[n]} for n in (0, 1)]
    connections.append({"tag_a": "a/2", "tag_b": "b/2", "established": False})
    engine = {**await watched(), "connections": connections}
    pages.send("engine", json.dumps({"type": "engine", **engine}))
    view = FleetView()
    fleet = FleetLink.__new__(FleetLink)  # nobody steers
    args = ["--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking"]
    async with TestServer(Station(view, fleet, pages).make_app()) as server, async_playwright() as playwright:
        browser = await playwright.chromium.launch(executable_path=CHROMIUM, args=args)
        try:
            page = await browser.new_page()
            await page.goto(str(server.make_url("/")))
            await page.wait_for_selector("#engine meter")
            meters = await page.eval_on_selector_all(
                "#engine meter", "all => all.map(m => [m.value / m.max, m.ariaLabel])"
            )
            await page.locator("#connections summary").click()
            await page.locator("#connections tr").nth(2).wait_for()
            pages.send("engine", json.dumps({"type": "engine", "error": "", **engine}))
            rows = await page.locator("#connections td").all_inner_texts()
            text = await page.inner_text("#engine")
        finally:
            await browser.close()
    assert meters == [
        [0.5, "CPU: 25 % of 50 %"],
        [0.95, "Memory: 95 MB of 100 MB"],
        [0.25, "Slots: 2 of 8"],
        [0.375, "Cores: 1.5 of 4"],
        [0.25, "Memory: 250 MB of 1000 MB"],
    ]
    assert rows == [
        *("a/1 \u2194 b/1", "40/s, 51 kB/s"),
        *("a/0 \u2194 b/0", "2.5/s, 0.9 kB/s"),
        *("a/2 \u2194 b/2", "not established"),
    ]
    for part in (
        "2 of 3 connections established, 43 messages/s, 52 kB/s",
        "c degraded m1",
        "2 restarts",
        "too small: uses 95 MB",
        "rce resize c --memory 150M",
        "n waiting again in 2 s",
        "d starting m1, moving to c2",
        "m1 draining 2 containers",
    ):
        assert part in text
