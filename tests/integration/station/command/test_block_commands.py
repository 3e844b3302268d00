"""``rce fleet block`` and ``rce fleet free``: what they ask a station for, with and without a manager."""

from __future__ import annotations

import time

import pytest
from support.commanded_station import TOKEN, Station, run


async def test_cells_are_blocked_with_a_reason_an_end_and_robots(station: Station, url: str) -> None:
    code, told = await run(url, "block", "4", "5")
    assert (code, told) == (0, "cell 4 is blocked\ncell 5 is blocked\n")
    assert station.changes == ["PUT cells/4", "PUT cells/5"]
    station.changes.clear()
    station.bodies.clear()
    began = time.time()
    code, told = await run(
        url, "block", "4", "4>5", "--robot", "R2", "--robot", "R1", "--reason", "oil", "--for", "60"
    )
    assert (code, told.splitlines()[1].split(" until ")[0]) == (0, "the move 4>5 is blocked for R1, R2")
    assert station.changes == ["PUT zones/block 4 for R1 R2", "PUT zones/block 4>5 for R1 R2"]
    cell, move = station.bodies
    assert (cell["cells"], cell["edges"], cell["robots"], cell["reason"]) == ([4], [], ["R1", "R2"], "oil")
    assert (move["cells"], move["edges"]) == ([], [[4, 5]])
    assert 60 <= cell["until"] - began < 120


async def test_lanes_are_blocked_by_their_names(station: Station, url: str) -> None:
    code, told = await run(url, "block", "--lane", "bay", "--lane", "out")
    assert (code, told) == (0, "lane bay is blocked\nlane out is blocked\n")
    assert station.changes == ["PUT zones/block lane bay", "PUT zones/block lane out"]
    assert [zone["edges"] for zone in station.bodies] == [[[4, 12], [12, 20], [12, 4], [20, 12]], [[0, 1]]]
    code, told = await run(url, "block", "--lane", "in")
    assert (code, "unknown lane 'in'; lanes are bay, out" in " ".join(told.split())) == (2, True)


async def test_what_was_blocked_is_freed(station: Station, url: str) -> None:
    """For one robot only what was blocked for it; without one, everything of the place."""
    station.zones = [
        "block 4",
        "block 4 for R1",
        "block 4 for R1 R2",
        "block 4>5",
        "block 44",
        "block lane bay",
    ]
    assert await run(url, "free", "4", "--robot", "R1") == (0, "cell 4 is free for R1\n")
    assert station.changes == ["DELETE zones/block 4 for R1"]
    station.changes.clear()
    assert await run(url, "free", "4", "4>5", "--lane", "bay") == (
        0,
        "cell 4 is free\nthe move 4>5 is free\nlane bay is free\n",
    )
    assert station.changes == [
        *(f"DELETE zones/block 4{whom}" for whom in ("", " for R1", " for R1 R2")),
        "PUT cells/4",
        "DELETE zones/block 4>5",
        "DELETE zones/block lane bay",
    ]


@pytest.mark.parametrize("words", [("4>5",), ("--lane", "bay"), ("4", "--robot", "R1"), ("4", "4>5")])
async def test_nothing_is_freed_without_a_manager(station: Station, url: str, words: tuple[str, ...]) -> None:
    """Moves, lanes and cells for some robots are zones: nothing was done, but "is free" was printed."""
    station.has_manager = False
    code, told = await run(url, "free", *words)
    assert (code, told, station.changes) == (1, "rce fleet: the fleet manager did not answer\n", [])


async def test_cells_are_freed_without_a_manager(station: Station, url: str) -> None:
    """A fleet may have none. What it says of its zones goes to the errors."""
    station.has_manager = False
    code, told = await run(url, "free", "4")
    assert (code, station.changes) == (0, ["PUT cells/4"])
    assert told.splitlines() == [
        "rce fleet: zones are left as they are, they cannot be read: the fleet manager did not answer",
        "cell 4 is free",
    ]


async def test_a_cell_has_reason_and_end_without_a_manager(station: Station, url: str) -> None:
    """A zone needs a manager; a cell for all robots does not."""
    station.has_manager = False
    began = time.time()
    code, told = await run(url, "block", "4", "--reason", "oil", "--for", "60")
    assert (code, told.split(" until ")[0], station.changes) == (0, "cell 4 is blocked", ["PUT cells/4"])
    asked = station.bodies[-1]
    assert 60 <= asked.pop("until") - began < 120
    assert asked == {"blocked": True, "reason": "oil"}
    code, told = await run(url, "block", "4>5", "--reason", "oil")
    assert (code, told) == (1, "rce fleet: the fleet manager did not answer\n")


async def test_free_of_what_was_not_blocked_fails(station: Station, url: str) -> None:
    station.zones = ["block 4>5"]
    code, told = await run(url, "free", "4>5", "5>4", "4", "--robot", "R1")
    assert (code, station.changes) == (1, [])
    assert "not blocked by rce fleet block: the move 4>5 for R1, the move 5>4 for R1, cell 4 for R1" in told
    code, told = await run(url, "free", "5>4", "4>5")
    assert (code, station.changes) == (1, ["DELETE zones/block 4>5"])
    assert told.splitlines()[0] == "the move 4>5 is free"
    assert "not blocked by rce fleet block: the move 5>4;" in told


async def test_free_without_a_login_says_so(station: Station, url: str) -> None:
    station.wants = TOKEN
    code, told = await run(url, "free", "4")
    assert (code, "log in" in told, station.changes) == (1, True, [])


@pytest.mark.parametrize(
    ("words", "text"),
    [
        ((), "name a cell, such as 12, a move, such as 12>13, or a --lane"),
        (("4>",), "expected a cell, such as 12, or a move, such as 12>13, found '4>'"),
        (("4", "--for", "9", "--until", "23:59"), "give either --for or --until"),
        (("4", "--until", "soon"), "expected a time such as 18:30 or 2026-11-28T18:30, found 'soon'"),
        (("4", "--until", "25:00"), "expected a time such as 18:30"),
        (("4", "--until", "2020-01-01"), "2020-01-01 has passed"),
    ],
)
async def test_places_and_times_that_are_none(
    station: Station, url: str, words: tuple[str, ...], text: str
) -> None:
    code, told = await run(url, "block", *words)
    assert (code, station.changes) == (2, [])
    assert text in " ".join(told.replace("│", " ").split())
