"""``rce fleet place``, and commands that list a part: what they ask a station for."""

from __future__ import annotations

from collections.abc import AsyncIterator
from typing import Any

import pytest
from aiohttp import web
from support.commanded_station import ROBOT, run, served

from rce_fleet.api.fleet import ChargersState, EventPage, RobotList

HEADER = "number,time,kind\r\n"


class Places:
    """A web server with some of a station's routes."""

    def __init__(self) -> None:
        self.state = ChargersState(
            chargers=[56, 63], parking=[0], returns=[], charging={"R1": 63}, waiting=["R2"], revision=4
        )
        self.changes: list[tuple[str, Any]] = []
        """If-Match and body of each change."""
        self.queries: list[dict[str, str]] = []

    async def answer(self, request: web.Request) -> web.Response:
        self.queries.append(dict(request.query))
        path = request.path.removeprefix("/api/v1/")
        if path == "history" and "format" in request.query:
            return web.Response(text=HEADER, content_type="text/csv")
        if request.method == "PUT":
            body = await request.json()
            self.changes.append((request.headers.get("If-Match", ""), body))
            self.state = self.state.model_copy(update=body)
        found = {
            "chargers": self.state,
            "robots": RobotList(robots=[ROBOT]),
            "history": EventPage(events=[], next=0, journal="a", newest=0),
        }
        return web.Response(text=found[path].model_dump_json(), content_type="application/json")


@pytest.fixture
def places() -> Places:
    return Places()


@pytest.fixture
async def url(places: Places) -> AsyncIterator[str]:
    async with served(places.answer) as address:
        yield address


async def test_places_are_listed(url: str) -> None:
    code, told = await run(url, "place", "list")
    assert code == 0, told
    assert [line.split() for line in told.splitlines()] == [
        ["cell", "kind", "robot"],
        ["56", "charger", "-"],
        ["63", "charger", "R1"],
        ["0", "parking", "-"],
        ["waiting", "for", "a", "charger:", "R2"],
    ]


@pytest.mark.parametrize(
    ("words", "told", "changed"),
    [
        ("add 7 56 8", "charger: 56 63 7 8", {"chargers": [56, 63, 7, 8]}),
        ("add 3 --kind return", "return: 3", {"returns": [3]}),
        ("remove 56", "charger: 63", {"chargers": [63]}),
        ("remove 0 --kind parking", "parking: none", {"parking": []}),
    ],
)
async def test_places_are_added_and_removed(
    places: Places, url: str, words: str, told: str, changed: dict[str, list[int]]
) -> None:
    """Those of other kinds stay; a change that another user makes meanwhile is not undone."""
    before = {"chargers": [56, 63], "parking": [0], "returns": []}
    assert await run(url, "place", *words.split()) == (0, f"{told}\n")
    assert places.changes == [('"4"', before | changed)]


async def test_a_place_that_is_none_is_not_removed(places: Places, url: str) -> None:
    code, told = await run(url, "place", "remove", "56", "0")
    assert (code, places.changes) == (1, [])
    assert "expected cells of the kind charger, found 0; see rce fleet place list" in told


@pytest.mark.parametrize(
    ("words", "query"),
    [
        (
            "robots --state driving,waiting --activity task",
            {"state": "driving,waiting", "activity": "task"},
        ),
        ("history --kind task,zone --robot R1", {"kind": "task,zone", "robot": "R1", "format": "csv"}),
        ("history --kind task --json", {"kind": "task"}),
        ("robots", {}),
        ("history", {"format": "csv"}),
    ],
)
async def test_some_robots_and_events_are_asked_for(
    places: Places, url: str, words: str, query: dict[str, str]
) -> None:
    code, told = await run(url, *words.split())
    assert code == 0, told
    (found,) = places.queries
    assert {name: text for name, text in found.items() if name not in ("since", "limit")} == query
