"""``rce fleet`` at a station: which token it sends, JSON, recurring tasks, texts with control codes."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import pytest
from support.commanded_station import FIGURES, ROBOT, TASK, TOKEN, Station, run

from rce_fleet.api.tasks import TaskRequest
from rce_fleet.cli.access import why_not_sent


def keep_login(file: Path, engine: str) -> None:
    kept = {"url": engine, "user": "ada", "token": TOKEN, "expires": time.time() + 3600}
    file.write_text(json.dumps(kept))


async def test_a_login_is_not_sent_to_a_station_of_others(station: Station, url: str, login: Path) -> None:
    keep_login(login, "http://engine.example.org:9000/")
    assert (await run(url, "robots"))[0] == 0
    assert station.tokens == [""]
    station.wants = TOKEN
    code, told = await run(url, "robots")
    assert (code, station.tokens[1:]) == (1, [""])
    assert "127.0.0.1 is not a host of that engine" in told
    assert "--send-login" in told
    assert (await run(url, "--send-login", "robots"))[0] == 0
    assert station.tokens[2:] == [TOKEN]


async def test_a_login_is_sent_to_the_station_beside_its_engine(
    station: Station, url: str, login: Path
) -> None:
    keep_login(login, "http://one.example.org:9000/,http://localhost:9000/")
    station.wants = TOKEN
    assert (await run(url, "robots"))[0] == 0
    assert station.tokens == [TOKEN]
    assert (await run(url, "--token", "another", "robots"))[0] == 1
    assert station.tokens[1:] == ["another"]


@pytest.mark.parametrize(
    ("engine", "station", "why"),
    [
        ("http://cloud:9000/", "http://cloud:9080", ""),
        ("http://cloud:9000/", "http://CLOUD.:9080", ""),
        ("http://cloud:9000/", "https://cloud", ""),
        ("https://cloud:9000/", "https://cloud", ""),
        ("https://cloud:9000/", "http://cloud:9080", "not encrypted"),
        ("https://localhost:9000/", "http://[::1]:9080", ""),
        ("http://a:9000/,http://b:9000/", "http://b:9080", ""),
        ("http://cloud:9000/", "http://cloud.example.org:9080", "not a host of that engine"),
        ("http://cloud:9000/", "http://cloud@evil.example.org:9080", "evil.example.org is not a host"),
        ("http://cloud:9000/", "http://127.0.0.1:9080", "not a host of that engine"),
        ("http://cloud:9000/", "http://[::1", "cannot be read"),
    ],
)
def test_the_token_of_a_login_stays_with_its_engine(engine: str, station: str, why: str) -> None:
    found = why_not_sent(engine, station)
    assert why in found
    assert bool(why) == bool(found)


async def test_rce_fleet_prints_json(url: str) -> None:
    """As the API returns it; a terminal interprets nothing in it."""
    robots = ["robots", "--json"]
    for words, expected in (
        (robots, [ROBOT.model_dump(mode="json")]),
        (["tasks", "--json"], [TASK.model_dump(mode="json")]),
        (["task", "show", "T7", "--json"], TASK.model_dump(mode="json")),
        (["statistics", "--json"], FIGURES.model_dump(mode="json")),
    ):
        code, told = await run(url, *words)
        assert (code, json.loads(told)) == (0, expected), words
        assert "\x1b" not in told


@pytest.mark.parametrize("words", [["robots"], ["tasks"], ["task", "show", "T7"]])
async def test_rce_fleet_prints_no_control_codes(url: str, words: list[str]) -> None:
    """A task's name or reason is written by another user."""
    code, told = await run(url, *words)
    assert (code, "owned" in told) == (0, True)
    assert "\x1b" not in told
    assert "\x07" not in told


async def test_rce_fleet_adds_a_recurring_task(station: Station, url: str) -> None:
    code, told = await run(url, "task", "add", "--cell", "5", "--every", "3600", "--count", "10")
    assert (code, told) == (0, "T7\n")
    task = TaskRequest.model_validate(station.bodies[0])
    assert task.repeat is not None
    assert (task.repeat.every, task.repeat.count) == (3600, 10)
    assert (await run(url, "task", "add", "--cell", "5", "--every", "60"))[0] == 0
    assert station.bodies[1]["repeat"]["count"] is None
    for wrong, value in ((["--count", "2"], "count"), (["--every", "0"], "every")):
        code, told = await run(url, "task", "add", "--cell", "5", *wrong)
        assert (code, f"Invalid value for {value}" in told) == (2, True), told
    assert len(station.bodies) == 2


async def test_rce_fleet_repeats_a_task_with_its_dates(station: Station, url: str) -> None:
    """Seconds from now would be another content, which a second request with the key must not have."""
    words = ["task", "add", "--cell", "5", "--key", "order-1"]
    dates = ["--start", "2026-11-28T18:00", "--deadline", "2026-11-28T18:30"]
    for _ in range(2):
        assert await run(url, *words, *dates) == (0, "T7\n")
    first, second = station.bodies
    assert first == second
    assert first["deadline"] - first["earliest_start"] == 1800
    now = time.time()
    assert (await run(url, "task", "add", "--cell", "5", "--deadline", "600", "--start", "0"))[0] == 0
    assert now + 600 <= station.bodies[2]["deadline"] <= time.time() + 600
    assert station.bodies[2]["earliest_start"] is None
    code, told = await run(url, "task", "add", "--cell", "5", "--deadline", "soon")
    told = " ".join(told.replace("│", " ").split())
    assert (code, "expected seconds from now, or a time such as 18:30" in told) == (2, True), told


async def test_rce_fleet_tells_the_key_without_an_answer(station: Station, url: str) -> None:
    """The task may have been created: only with its key does a second command not make another one."""
    station.lost = 3  # as often as the command asks
    code, told = await run(url, "task", "add", "--cell", "5")
    assert (code, len(station.bodies), station.lost) == (1, 3, 0)
    key = station.bodies[0]["key"]
    assert told.endswith(f"to repeat the command without a second task, add --key {key}\n")
    assert await run(url, "task", "add", "--cell", "5", "--key", key) == (0, "T7\n")
    assert station.bodies == [station.bodies[0]] * 4


async def test_rce_fleet_makes_lists_and_removes_zones(station: Station, url: str) -> None:
    """With a reason, an end, robots and moves."""
    now = time.time()
    words = ["--kind", "slow", "--value", "0.2", "--robot", "R1", "--reason", "wet", "--for", "60"]
    assert await run(url, "zone", "add", "gate", "4", "5", *words) == (
        0,
        "zone gate: blocked, 1 cells, 1 moves\n",
    )
    (body,) = station.bodies
    assert now + 60 <= body.pop("until") <= time.time() + 60
    assert body == {
        "kind": "slow",
        "value": 0.2,
        "cells": [4, 5],
        "edges": [],
        "robots": ["R1"],
        "reason": "wet",
    }
    assert (await run(url, "zone", "add", "gate", "--edge", "12>13"))[0] == 0
    assert station.bodies[-1]["edges"] == [[12, 13]]
    code, told = await run(url, "zone", "add", "gate", "--edge", "12")
    assert (code, "a move is written as 12>13" in told) == (2, True)
    assert "gate  blocked  -      4 12>13  all     -      ada" in (await run(url, "zone", "list"))[1]
    assert await run(url, "zone", "remove", "gate") == (0, "zone gate is removed\n")
    assert station.changes == ["PUT zones/gate", "PUT zones/gate", "DELETE zones/gate"]


@pytest.mark.parametrize(
    ("words", "change", "body"),
    [
        ("task confirm T7", "POST tasks/T7/confirm", None),
        ("task load T7 --cell 12", "POST tasks/T7/load", {"cell": 12}),
        ("task load T7 --lost", "POST tasks/T7/load", {"cell": None}),
        ("pause R1 --reason visitors", "POST robots/R1/pause", {"reason": "visitors"}),
        ("resume R1", "POST robots/R1/resume", None),
    ],
)
async def test_rce_fleet_does_what_waits_for_people(
    station: Station, url: str, words: str, change: str, body: Any
) -> None:
    code, told = await run(url, *words.split())
    assert (code, station.changes) == (0, [change]), told
    assert station.bodies == ([] if body is None else [body])


@pytest.mark.parametrize(
    ("words", "change", "body", "told"),
    [
        (
            "pause --all --reason fire",
            "PUT mode",
            {"mode": "paused", "reason": "fire"},
            "the fleet is paused",
        ),
        ("resume --all", "PUT mode", {"mode": "automatic", "reason": ""}, "the fleet drives"),
        ("emergency-stop --all", "PUT emergency-stop", {"stopped": True}, "all robots: stopped"),
        (
            *("emergency-stop R1 --release", "PUT robots/R1/emergency-stop"),
            *({"stopped": False}, "R1: released"),
        ),
    ],
)
async def test_rce_fleet_stops_the_whole_fleet(
    station: Station, url: str, words: str, change: str, body: Any, told: str
) -> None:
    assert await run(url, *words.split()) == (0, f"{told}\n")
    assert (station.changes, station.bodies) == ([change], [body])


async def test_rce_fleet_tells_who_was_not_stopped(station: Station, url: str) -> None:
    station.missed = ["R2", "R3"]
    code, told = await run(url, "emergency-stop", "--all")
    assert (code, "not reached yet: R2, R3;" in told) == (1, True)


@pytest.mark.parametrize("words", ["pause", "resume R1 --all", "emergency-stop"])
async def test_rce_fleet_stops_one_robot_or_all(station: Station, url: str, words: str) -> None:
    code, told = await run(url, *words.split())
    assert (code, station.changes) == (2, [])
    assert "name one robot, or give --all" in " ".join(told.replace("│", " ").split())


async def test_rce_fleet_shows_a_question_with_its_answer(url: str) -> None:
    told = (await run(url, "task", "show", "T7"))[1]
    assert "Where is the load that R1 has? (rce fleet task load T7 --cell CELL, or --lost)" in told


@pytest.mark.parametrize("words", ["", "--lost --cell 3", "--cell -1"])
async def test_rce_fleet_refuses_an_unclear_load(station: Station, url: str, words: str) -> None:
    code, told = await run(url, "task", "load", "T7", *words.split())
    assert (code, "Invalid value" in told, station.changes) == (2, True, []), told
