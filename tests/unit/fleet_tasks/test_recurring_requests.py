"""Requests about a recurring task between two of its occurrences."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from support.fleet_manager import GO, ManagerClient

from rce_fleet.limits import MOST_TIME
from rce_fleet.manager import manager as managers
from rce_fleet.tasks.task import Task, TaskState


async def _between_occurrences(client: ManagerClient, **fields: Any) -> Task:
    """Create a recurring task, and let its first occurrence be done a second later."""
    await client.ask("POST", "/tasks", {**GO, "repeat": {"every": 3600, "count": 5}, **fields})
    book = client.manager.book
    task = book.tasks[1]
    book.emit(replace(task, state=TaskState.DONE, position=1, revision=2), "finished", client.manager.clock())
    await client.manager.commit()
    return book.tasks[1]


async def test_a_recurring_task_ends_between_occurrences(client: ManagerClient) -> None:
    """It stays done, and no occurrence follows; a second request says the same."""
    task = await _between_occurrences(client)
    (listed,) = (await client.ask("GET", "/tasks?state=recurring"))[1]["tasks"]
    assert (listed["id"], listed["state"], listed["recurs_at"]) == ("T1", "done", task.recurs_at)
    assert (await client.ask("DELETE", "/tasks/T1", revision='"1"'))[0] == 412
    for _ in range(2):
        status, body, _ = await client.ask("DELETE", "/tasks/T1")
        assert (status, body["state"], body["recurs_at"]) == (200, "done", None)
    assert task.recurs_at is not None
    client.manager.dispatcher.update(task.recurs_at + 1, client.manager.facts)
    assert list(client.manager.book.tasks) == [1]
    assert (await client.ask("GET", "/tasks?state=recurring"))[1]["tasks"] == []


@pytest.mark.parametrize(
    ("change", "due", "expected"),
    [
        ({"stops": [{"cell": 7}], "priority": 3}, 3600.0, {"priority": 3, "occurrence": 2}),
        ({"repeat": {"every": 60}}, 60.0, {"occurrence": 2}),
        ({"name": "round"}, 3600.0, {"deadline": 4000.0}),
        ({"deadline": 4600.0}, 3600.0, {"deadline": 4600.0}),
        ({"earliest_start": 9000.0}, 9000.0, {"deadline": 9400.0}),
    ],
)
async def test_a_change_between_occurrences_counts_for_the_next(
    client: ManagerClient, change: dict[str, Any], due: float, expected: dict[str, Any]
) -> None:
    """Times are seconds after the start of the first occurrence, which has a deadline 400 s later."""
    start = client.manager.clock()
    await _between_occurrences(client, earliest_start=start, deadline=start + 400)

    def shifted(fields: dict[str, Any]) -> dict[str, Any]:
        times = ("deadline", "earliest_start")
        return {name: value + start if name in times else value for name, value in fields.items()}

    status, body, _ = await client.ask("PATCH", "/tasks/T1", shifted(change))
    assert (status, body["state"]) == (200, "done")
    assert body["recurs_at"] == pytest.approx(start + due, abs=30.0)
    assert body["earliest_start"] == body["recurs_at"]
    assert (await client.ask("PATCH", "/tasks/T1", shifted(change)))[1] == body
    client.manager.dispatcher.update(body["recurs_at"] + 1, client.manager.facts)
    following = (await client.ask("GET", "/tasks/T2"))[1]
    assert following["stops"] == body["stops"]
    assert following["earliest_start"] == body["recurs_at"]
    for name, value in shifted(expected).items():
        assert following[name] == pytest.approx(value, abs=1e-3)


async def test_an_occurrence_beyond_the_latest_time_is_shown(client: ManagerClient) -> None:
    """Its start was later than what an answer may have: the list of all tasks failed."""
    await _between_occurrences(client, earliest_start=MOST_TIME)
    status, body, _ = await client.ask("PATCH", "/tasks/T1", {"priority": 3})
    assert (status, body["earliest_start"]) == (200, MOST_TIME)
    client.manager.book.recur(client.manager.book.tasks[1], client.manager.clock())
    listed = (await client.ask("GET", "/tasks"))[1]["tasks"]
    assert [task["earliest_start"] for task in listed] == [MOST_TIME, MOST_TIME]


@pytest.mark.parametrize("change", [{"repeat": None}, {"repeat": {"every": 3600, "count": 1}}])
async def test_a_change_between_occurrences_ends_a_recurrence(
    client: ManagerClient, change: dict[str, Any]
) -> None:
    await _between_occurrences(client)
    assert (await client.ask("PATCH", "/tasks/T1", change))[1]["recurs_at"] is None
    assert (await client.ask("PATCH", "/tasks/T1", {"priority": 3}))[0] == 409


@pytest.mark.parametrize(
    "change", [{"stops": [{"cell": 9}]}, {"deadline": 1.0}, {"after": ["T1"]}, {"repeat": {"every": 0.5}}]
)
async def test_an_impossible_change_between_occurrences_is_refused(
    client: ManagerClient, change: dict[str, Any]
) -> None:
    before = await _between_occurrences(client)
    assert (await client.ask("PATCH", "/tasks/T1", change))[0] in (409, 422)
    assert client.manager.book.tasks[1] == before


async def test_the_key_of_a_recurring_task_lasts_as_long_as_it_recurs(
    client: ManagerClient, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The request that is sent again when its first occurrence is forgotten makes no second series."""
    monkeypatch.setattr(managers, "KEEP_ENDED", 0)
    task = await _between_occurrences(client, key="round-1")
    assert task.recurs_at is not None
    client.manager.dispatcher.update(task.recurs_at + 1, client.manager.facts)
    await client.ask("POST", "/tasks", {"stops": [{"cell": 3}]})
    await client.ask("POST", "/tasks", {"stops": [{"cell": 4}]})
    assert (await client.ask("GET", "/tasks/T1"))[0] == 404, "its first occurrence was not forgotten"
    again = {**GO, "repeat": {"every": 3600, "count": 5}, "key": "round-1"}
    status, body, _ = await client.ask("POST", "/tasks", again)
    assert (status, body["id"], body["occurrence"]) == (200, "T2", 2)
    assert (await client.ask("POST", "/tasks", {**again, "priority": 1}))[0] == 409
    await client.manager.close()
    following = ManagerClient(tmp_path / "j.sqlite")
    client.manager, client.journal = following.manager, following.journal
    assert (await following.ask("POST", "/tasks", again))[1]["id"] == "T2"
    await following.ask("DELETE", "/tasks/T2")
    await following.ask("POST", "/tasks", GO)
    await following.ask("POST", "/tasks", GO)
    assert (await following.ask("POST", "/tasks", again))[0] == 201
