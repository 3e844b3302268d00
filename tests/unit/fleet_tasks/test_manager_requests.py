"""Requests to the fleet manager without ROS: answers, roles, pages, revisions, keys, bad input."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError
from support.fleet_manager import GO, ManagerClient

from rce_fleet.manager import manager as managers
from rce_fleet.manager import task_routes
from rce_fleet.station.api import GoalRequest
from rce_fleet.tasks.facts import RobotFacts
from rce_fleet.tasks.loads import carried
from rce_fleet.tasks.records import RobotEntry
from rce_fleet.tasks.task import TaskState


async def test_pages_of_tasks_follow_each_other(client: ManagerClient) -> None:
    for _ in range(5):
        assert (await client.ask("POST", "/tasks", GO))[0] == 201
    first = (await client.ask("GET", "/tasks?limit=2"))[1]
    second = (await client.ask("GET", f"/tasks?limit=2&cursor={first['next']}"))[1]
    newest = (await client.ask("GET", "/tasks?order=desc&limit=1"))[1]
    assert [task["id"] for task in first["tasks"] + second["tasks"]] == ["T1", "T2", "T3", "T4"]
    assert newest["tasks"][0]["id"] == "T5"
    await client.ask("DELETE", "/tasks/T3")
    await client.ask("PATCH", "/tasks/T2", {"deadline": 5e9})
    due = (await client.ask("GET", "/tasks?deadline_before=5000000001"))[1]
    assert [task["id"] for task in due["tasks"]] == ["T2"]
    assert (await client.ask("GET", "/tasks?deadline_before=5000000000"))[1]["tasks"] == []
    ended = (await client.ask("GET", "/tasks?state=ended"))[1]
    assert ([task["id"] for task in ended["tasks"]], ended["next"]) == (["T3"], None)


async def test_pages_of_zones_follow_each_other(client: ManagerClient) -> None:
    for name in ("dock", "aisle", "crossing", "gate"):
        zone = (
            {"kind": "slow", "cells": [3], "value": 0.5}
            if name == "dock"
            else {"kind": "blocked", "cells": [4]}
        )
        assert (await client.ask("PUT", f"/zones/{name}", zone))[0] == 201

    async def listed(query: str) -> tuple[list[str], str | None]:
        found = (await client.ask("GET", f"/zones?{query}"))[1]
        return [zone["id"] for zone in found["zones"]], found["next"]

    assert await listed("") == (["aisle", "crossing", "dock", "gate"], None)
    assert await listed("limit=3") == (["aisle", "crossing", "dock"], "dock")
    assert await listed("limit=3&cursor=dock") == (["gate"], None)
    assert await listed("kind=blocked,cost&limit=2") == (["aisle", "crossing"], "crossing")
    assert await listed("kind=blocked,cost&limit=2&cursor=crossing") == (["gate"], None)
    assert (await client.ask("GET", "/zones?limit=many"))[0] == 422


async def test_events_are_asked_for_by_kind_and_robot(client: ManagerClient) -> None:
    await client.ask("POST", "/tasks", GO)
    client.manager.facts.robots["Robot1"] = RobotFacts("Robot1", "idle", cell=3)
    await client.ask("POST", "/robots/Robot1/pause")
    for path, kinds in (
        ("/events?kind=task", {"task"}),
        ("/history?kind=robot,zone", {"robot"}),
        ("/events?robot=Robot1", {"robot"}),
        ("/events?kind=task&robot=Robot1", set()),
    ):
        found = (await client.ask("GET", path))[1]["events"]
        assert {event["kind"] for event in found} == kinds, path
    status, said, _ = await client.ask("GET", "/history?kind=tasks")
    assert (status, "unknown kind 'tasks'; possible are task, robot" in said["error"]) == (422, True)


async def test_robots_are_listed_by_state_and_activity(client: ManagerClient) -> None:
    states = {"Robot1": "idle", "Robot2": "silent", "Robot3": "idle", "Robot4": "driving"}
    for name, state in states.items():
        client.manager.facts.robots[name] = RobotFacts(name, state, cell=3)

    async def listed(query: str) -> tuple[list[str], str | None]:
        found = (await client.ask("GET", f"/robots?{query}"))[1]
        return [robot["id"] for robot in found["robots"]], found["next"]

    assert await listed("") == (list(states), None)
    assert await listed("state=idle,silent&limit=2") == (["Robot1", "Robot2"], "Robot2")
    assert await listed("state=idle,silent&limit=2&cursor=Robot2") == (["Robot3"], None)
    assert await listed("limit=4") == (list(states), None)
    assert (await client.ask("POST", "/robots/Robot3/take-out"))[0] == 200
    assert await listed("activity=out") == (["Robot3"], None)
    assert (await client.ask("GET", "/robots/Robot3/manager"))[1]["activity"] == "out"


async def test_an_old_etag_is_refused(client: ManagerClient) -> None:
    _, _, revision = await client.ask("POST", "/tasks", GO)
    status, body, newer = await client.ask("PATCH", "/tasks/T1", {"priority": 3}, revision=revision)
    assert (status, body["priority"], newer) == (200, 3, '"2"')
    assert (await client.ask("PATCH", "/tasks/T1", {"priority": 4}, revision=revision))[0] == 412
    assert (await client.ask("PUT", "/chargers", {"chargers": [63]}, revision='"0"'))[0] == 200
    assert (await client.ask("PUT", "/chargers", {"chargers": []}, revision='"0"'))[0] == 412


async def test_the_etag_of_a_removed_zone_fits_no_new_one(client: ManagerClient, tmp_path: Path) -> None:
    """Another person removed the zone and made one of the same name: their zone was replaced."""
    zone = {"kind": "slow", "cells": [3], "value": 0.3}
    _, _, seen = await client.ask("PUT", "/zones/gate", zone)
    await client.ask("DELETE", "/zones/gate")
    await client.manager.close()
    following = ManagerClient(tmp_path / "j.sqlite")
    client.manager = following.manager
    _, _, newer = await following.ask("PUT", "/zones/gate", {"kind": "blocked", "cells": [4]}, revision='"0"')
    assert (await following.ask("PUT", "/zones/gate", zone, revision=seen))[0] == 412
    assert (await following.ask("DELETE", "/zones/gate", revision=seen))[0] == 412
    assert (await following.ask("PUT", "/zones/gate", zone, revision=newer))[0] == 200


async def test_a_viewer_changes_nothing(client: ManagerClient) -> None:
    assert (await client.ask("POST", "/tasks", GO, role="viewer"))[0] == 403
    assert (await client.ask("GET", "/tasks", role="viewer"))[:2] == (200, {"tasks": [], "next": None})


async def test_robots_are_listed_by_what_changed(client: ManagerClient) -> None:
    """A page with 1000 robots asked for all of them every two seconds."""
    robots = client.manager.facts.robots
    for number in range(1, 1001):
        robots[f"Robot{number}"] = RobotFacts(f"Robot{number}", "idle", cell=3, battery=0.8)

    async def changed(since: int) -> tuple[list[str], int]:
        found = (await client.ask("GET", f"/robots?since={since}"))[1]
        return [robot["id"] for robot in found["robots"]], found["version"]

    everything, first = await changed(0)
    assert len(everything) == 1000
    robots["Robot2"].cell, robots["Robot2"].state, robots["Robot2"].battery = 4, "driving", 0.8001
    assert await changed(first) == ([], first)
    assert (await client.ask("POST", "/robots/Robot7/pause"))[0] == 200
    robots["Robot3"].battery = 0.5
    found, second = await changed(first)
    assert (found, second > first) == (["Robot3", "Robot7"], True)
    assert await changed(second) == ([], second)
    assert await changed(first) == (["Robot3", "Robot7"], second), "another page, which asked before"
    assert len((await changed(second + 1))[0]) == 1000, "a version of another manager"
    assert (await client.ask("GET", "/robots?since=1&limit=5"))[0] == 422


@pytest.mark.parametrize("path", ["/robots/Robot1", "/robots/Robot1/take-out", "/robots/Robot1/goal"])
async def test_no_robot_is_denied_before_the_planner_has_told_its_robots(
    client: ManagerClient, path: str
) -> None:
    """A fleet manager that was killed does not know yet which robots there are."""
    grid, client.manager.facts.grid = client.manager.facts.grid, None
    method = {"Robot1": "GET", "take-out": "POST", "goal": "PUT"}[path.rpartition("/")[2]]
    body = {"cell": 3} if method == "PUT" else None
    status, said, _ = await client.ask(method, path, body)
    assert (status, said["error"]) == (503, "the planner has not told its robots yet; try again later")
    client.manager.facts.grid = grid
    assert (await client.ask(method, path, body))[0] == 404


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "path", "body", "status"),
    [
        ("POST", "/tasks", "{", 422),
        ("POST", "/tasks", {"stops": []}, 422),
        ("POST", "/tasks", {"stops": [{"cell": 5}], "colour": "red"}, 422),
        ("POST", "/tasks", {"stops": [{"cell": 5, "cells": [6]}]}, 409),
        ("POST", "/tasks", {"stops": [{"cell": 9}]}, 409),
        ("POST", "/tasks", '{"stops": [{"cell": 5, "duration": NaN}]}', 422),
        ("GET", "/tasks/T1", None, 404),
        ("GET", f"/tasks/T{'9' * 5000}", None, 404),
        ("POST", "/tasks", {**GO, "after": [f"T{'9' * 5000}"]}, 409),
        ("GET", "/tasks?state=sleeping", None, 422),
        ("GET", "/tasks?limit=many", None, 422),
        ("GET", "/tasks?limit=1.5", None, 422),
        ("GET", "/tasks?cursor=x", None, 422),
        ("GET", "/events?after=-1", None, 422),
        ("GET", "/nothing", None, 404),
        ("PUT", "/tasks", GO, 405),
        ("POST", "/robots/Robot9/pause", None, 404),
        ("PUT", "/chargers", {"chargers": [99]}, 409),
        ("DELETE", "/zones/z", None, 404),
        ("PUT", "/zones/z", {"kind": "icy", "cells": [1]}, 422),
        ("PUT", "/cells/9", {"blocked": True}, 409),
        ("PUT", "/cells/64", {"blocked": True}, 409),
        ("PUT", "/cells/-1", {"blocked": True}, 404),
        ("PUT", "/cells/8", {}, 422),
        ("PUT", "/zones/z", {"kind": "blocked", "cells": [64]}, 409),
        ("PUT", "/zones/z", {"kind": "blocked", "edges": [[0, 9]]}, 409),
        ("PUT", "/zones/z", {"kind": "blocked", "cells": [1], "until": 1.0}, 409),
        ("POST", "/tasks", {**GO, "deadline": -1e308}, 422),
        ("POST", "/tasks", {**GO, "deadline": 1e308}, 422),
        ("POST", "/tasks", {**GO, "earliest_start": -1.0}, 422),
        ("POST", "/tasks", {**GO, "earliest_start": 1e12}, 422),
        ("POST", "/tasks", {**GO, "payload": 1e308}, 422),
        ("POST", "/tasks", {**GO, "repeat": {"every": 60, "count": 10**30}}, 422),
        ("POST", "/tasks", {"stops": [{"cells": [10**30]}]}, 422),
        ("POST", "/tasks", {**GO, "return_cells": [-1]}, 422),
        ("PATCH", "/tasks/T1", {"deadline": 1e12}, 422),
        ("PATCH", "/robots/Robot1", {"profile": {"zone_cost": {"z": -2}}}, 422),
        ("PATCH", "/robots/Robot1", {"profile": {"zone_cost": {"z": 1e308}}}, 422),
        *(
            ("PATCH", "/robots/Robot1", {"profile": {name: value}}, 422)
            for name in ("payload", "speed", "capacity", "drive", "idle", "acting", "charging")
            for value in (-1.0, 1e308)
        ),
        ("PATCH", "/robots/Robot1", {"profile": {"speed": 1e-320}}, 422),
        ("PATCH", "/robots/Robot1", {"profile": {"capacity": 1e-320}}, 422),
        ("PUT", "/chargers", {"chargers": [2**31]}, 422),
        ("PUT", "/chargers", {"parking": [-1]}, 422),
        ("PUT", "/zones/z", {"kind": "limited", "cells": [1], "value": 3e9}, 409),
        ("PUT", "/zones/z", {"kind": "slow", "cells": [1], "value": 1e-320}, 409),
        ("PUT", "/zones/z", {"kind": "slow", "cells": [1], "value": 1e308}, 409),
        ("PUT", "/zones/z", {"kind": "cost", "cells": [1], "value": 1e308}, 409),
        ("PUT", "/zones/z", {"kind": "blocked", "cells": [2**31]}, 422),
        ("PUT", "/zones/z", {"kind": "blocked", "edges": [[0, -1]]}, 422),
        ("PUT", "/zones/z", {"kind": "blocked", "cells": [1], "until": 1e12}, 422),
        ("PUT", f"/cells/{2**31}", {"blocked": True}, 404),
        # What other languages return for "not found" must not send a robot to cell 0, or be the year 1970.
        ("POST", "/tasks", {"stops": [{"cell": False}]}, 422),
        ("POST", "/tasks", {"stops": [{"cells": [3, False]}]}, 422),
        ("POST", "/tasks", {**GO, "return_cells": [True]}, 422),
        ("POST", "/tasks", {**GO, "deadline": False}, 422),
        ("POST", "/tasks", {**GO, "earliest_start": True}, 422),
        ("PATCH", "/tasks/T1", {"stops": [{"cell": True}]}, 422),
        ("PUT", "/chargers", {"parking": [False]}, 422),
        ("PUT", "/zones/z", {"kind": "blocked", "cells": [True]}, 422),
        ("PUT", "/zones/z", {"kind": "blocked", "edges": [[False, 1]]}, 422),
    ],
)
async def test_bad_requests_say_why(
    client: ManagerClient, method: str, path: str, body: Any, status: int
) -> None:
    said, answer, _ = await client.ask(method, path, body)
    assert (said, set(answer)) == (status, {"error"})
    assert client.manager.book.number == 0


async def test_a_robot_is_sent_to_no_cell_that_is_false(client: ManagerClient) -> None:
    client.manager.facts.robots["Robot1"] = RobotFacts("Robot1", "idle", cell=5)
    status, answer, _ = await client.ask("PUT", "/robots/Robot1/goal", {"cell": False})
    assert (status, "true and false" in answer["error"]) == (422, True)
    assert client.manager.book.number == 0
    with pytest.raises(ValidationError, match="true and false"):
        GoalRequest.model_validate_json('{"cell": false}')


async def test_a_task_is_given_to_another_robot(client: ManagerClient) -> None:
    for name, cell in (("Robot1", 4), ("Robot2", 60)):
        client.manager.facts.robots[name] = RobotFacts(name, "idle", cell=cell)
    await client.ask("POST", "/tasks", {"stops": [{"cell": 7}]})
    await client.manager.step()
    assert (await client.ask("GET", "/tasks/T1"))[1]["robot_assigned"] == "Robot1"
    status, task, _ = await client.ask("POST", "/tasks/T1/reassign")
    assert (status, task["state"], task["robot_assigned"]) == (200, "queued", "")
    await client.manager.step()
    assert (await client.ask("GET", "/tasks/T1"))[1]["robot_assigned"] == "Robot2"


async def test_a_robot_shows_what_it_carries(client: ManagerClient) -> None:
    stops = [
        {"cell": cell, "action": "pick", "label": label} for cell, label in ((1, "A"), (2, ""), (3, "C"))
    ]
    stops += [{"cell": cell, "action": "deliver", "label": label} for cell, label in ((4, "C"), (5, ""))]
    await client.ask("POST", "/tasks", {"stops": [*stops, {"cell": 6, "action": "deliver"}], "name": "box"})
    book, names = client.manager.book, list[list[str]]()
    book.put_record(RobotEntry("Robot1"))
    for position, loads in enumerate((0, 1, 2, 3, 2, 1, 0)):
        task = replace(
            book.find("T1"), robot="Robot1", position=position, loads=loads, state=TaskState.RUNNING
        )
        book.put_record(task)
        names.append((await client.ask("GET", "/robots"))[1]["robots"][0]["loads"] if loads else [])
        assert names[-1] == list(carried(task))
    assert names == [[], ["A"], ["A", "box"], ["A", "box", "C"], ["A", "box"], ["box"], []]
    assert carried(replace(book.find("T1"), position=0, loads=1)) == ("box",)


async def test_a_known_key_gives_its_task_also_with_too_many_open_tasks(
    client: ManagerClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first answer was lost: 429 would say that the task was not accepted."""
    monkeypatch.setattr(task_routes, "MOST_OPEN", 2)
    assert (await client.ask("POST", "/tasks", GO, key="order-1"))[0] == 201
    assert (await client.ask("POST", "/tasks", GO, key="order-2"))[0] == 201
    status, body, _ = await client.ask("POST", "/tasks", GO, key="order-3")
    assert (status, "2 open tasks" in body["error"]) == (429, True)
    status, body, _ = await client.ask("POST", "/tasks", GO, key="order-1")
    assert (status, body["id"]) == (200, "T1")
    await client.ask("DELETE", "/tasks/T2")
    assert (await client.ask("POST", "/tasks", GO, key="order-3"))[0] == 201


async def test_one_requester_leaves_room_for_others(
    client: ManagerClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A program in a loop without keys made all tasks that can be open, and other users were refused."""
    monkeypatch.setattr(task_routes, "MOST_OPEN", 3)
    monkeypatch.setattr(task_routes, "MOST_OF_ONE", 2)
    for _ in range(2):
        assert (await client.ask("POST", "/tasks", GO))[0] == 201
    status, body, _ = await client.ask("POST", "/tasks", GO)
    assert (status, "erp has 2 open tasks" in body["error"]) == (429, True)
    assert (await client.ask("POST", "/tasks", GO, user="bob"))[0] == 201
    status, body, _ = await client.ask("POST", "/tasks", GO, user="bob")
    assert (status, "there are 3 open tasks" in body["error"]) == (429, True)
    client.manager._reload()
    assert client.manager.book.open_count_of("erp") == 2
    await client.ask("DELETE", "/tasks/T2")
    assert (await client.ask("POST", "/tasks", GO))[0] == 201


async def test_many_tasks_are_cancelled_at_once(client: ManagerClient) -> None:
    """As each of them by itself: with an event of each, and the load of one brought away."""
    for user in ("erp", "bob", "erp", "erp", "erp"):
        await client.ask("POST", "/tasks", GO, user=user)
    await client.ask("POST", "/tasks", {"stops": [{"cell": 5}], "repeat": {"every": 60}})
    book = client.manager.book
    book.put_record(replace(book.find("T3"), robot="Robot1", loads=1, state=TaskState.RUNNING))
    book.emit(replace(book.find("T4"), state=TaskState.DONE), "finished", 0.0)
    book.emit(replace(book.find("T6"), state=TaskState.DONE), "finished", 0.0)
    assert (await client.ask("DELETE", "/tasks?requester=erp&state=queued&limit=1"))[:2] == (
        200,
        {"tasks": ["T1"], "left": 1},
    )
    answer = {"tasks": ["T3", "T5", "T6"], "left": 0}
    assert (await client.ask("DELETE", "/tasks?requester=erp", user="ann"))[:2] == (200, answer)
    states = [task["state"] for task in (await client.ask("GET", "/tasks"))[1]["tasks"]]
    assert states == ["cancelled", "queued", "cancelling", "done", "cancelled", "done"]
    events = (await client.ask("GET", "/events?kind=task"))[1]["events"]
    done = [(event["id"], event["name"]) for event in events if event["user"] == "ann"]
    assert done == [("T3", "cancelling"), ("T5", "cancelled"), ("T6", "recurrence ended")]
    assert (await client.ask("DELETE", "/tasks?requester=erp"))[1] == {"tasks": [], "left": 0}


@pytest.mark.parametrize(
    ("query", "fields", "status", "text"),
    [
        ("", {}, 422, "give state, robot or requester"),
        ("?state=&requester=", {}, 422, "give state, robot or requester"),
        ("?state=late", {}, 422, "unknown state 'late'"),
        ("?colour=red", {}, 422, "unknown parameter 'colour'"),
        ("?state=open", {"revision": '"1"'}, 422, "If-Match is for one task"),
        ("?state=open", {"role": "viewer"}, 403, "may not change anything"),
    ],
)
async def test_many_tasks_are_not_cancelled_by_mistake(
    client: ManagerClient, query: str, fields: dict[str, str], status: int, text: str
) -> None:
    await client.ask("POST", "/tasks", GO)
    said, body, _ = await client.ask("DELETE", f"/tasks{query}", **fields)
    assert (said, text in body["error"]) == (status, True), body
    assert (await client.ask("GET", "/tasks/T1"))[1]["state"] == "queued"


@pytest.mark.parametrize("order", ["DESC", "newest", ""])
async def test_an_unknown_order_of_tasks_is_refused(client: ManagerClient, order: str) -> None:
    """It was taken for ascending."""
    status, body, _ = await client.ask("GET", f"/tasks?order={order}")
    assert (status, body["error"]) == (422, f"order must be asc or desc, not {order!r}")


async def test_statistics_say_how_far_back_tasks_are_known(
    client: ManagerClient, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Ten tasks an hour are done, and the newest three are kept: as if a day had three tasks."""
    now = 1e6
    client.manager.clock = lambda: now
    assert (await client.ask("GET", "/statistics?seconds=86400"))[1]["seconds"] == 86400
    monkeypatch.setattr(managers, "KEEP_ENDED", 3)
    for _ in range(10):
        now += 360.0
        _, task, _ = await client.ask("POST", "/tasks", GO)
        ended = client.manager.book.find(task["id"])
        client.manager.book.emit(replace(ended, state=TaskState.DONE, changed_at=now), "finished", now)
        await client.manager.commit()
    figures = (await client.ask("GET", "/statistics?seconds=86400"))[1]
    assert (figures["tasks_done"], figures["seconds"]) == (2, 720.0)
    assert figures["tasks_per_hour"] == pytest.approx(10.0)
    assert (await client.ask("GET", "/statistics?seconds=600"))[1]["seconds"] == 600
    await client.manager.close()
    following = ManagerClient(tmp_path / "j.sqlite")
    client.manager = following.manager
    following.manager.clock = lambda: now
    assert (await following.ask("GET", "/statistics?seconds=86400"))[1] == figures
