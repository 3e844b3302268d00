"""What zones make of robots' ways: detours around what is closed to one of them, and dearer metres. Pure."""

from __future__ import annotations

from dataclasses import replace
from math import inf
from typing import TYPE_CHECKING, TypeAlias

from rce_fleet.tasks.travel import CLOSES_MOVES

if TYPE_CHECKING:
    from rce_fleet.tasks.book import TaskBook
    from rce_fleet.tasks.facts import FleetFacts
    from rce_fleet.tasks.records import RobotProfile, Zone

OwnCosts: TypeAlias = dict[str, dict[str, float]]
"""How much a metre counts, by robot and zone, in place of what the zone says."""


def zone_profiles(book: TaskBook, facts: FleetFacts, default: RobotProfile) -> dict[str, RobotProfile]:
    """Return the profiles of robots for which zones count, with what a metre in each zone counts.

    A zone that is blocked for some robots counts without end for them, and one that closes moves for them is
    named with :data:`CLOSES_MOVES`. What a robot's own profile says about a cost zone comes before the zone's
    value. Robots with the same costs and the same profile share one object, so that they are looked at
    together.

    Args:
        book: Zones and profiles.
        facts: The robots.
        default: Profile of robots that have none of their own.
    """
    zones = [
        zone
        for zone in book.zones.values()
        if zone.kind == "cost" or (zone.robots and (zone.closes_moves or zone.kind == "blocked"))
    ]
    if not zones:
        return {}
    applying: dict[str, list[Zone]] = {}
    for zone in zones:
        for robot in zone.robots or facts.robots:
            applying.setdefault(robot, []).append(zone)
    made: dict[tuple[int, tuple[str, ...]], RobotProfile] = {}
    found = {}
    for robot in facts.robots:
        applied = applying.get(robot)
        if not applied:
            continue
        base = book.entry(robot).profile or default
        key = id(base), tuple(zone.id for zone in applied)
        if key not in made:
            costs = {zone.id: zone.value or 1.0 for zone in applied if zone.kind == "cost"}
            shut = {zone.id: inf for zone in applied if zone.kind == "blocked" and zone.cells}
            closing = {zone.id: CLOSES_MOVES for zone in applied if zone.closes_moves}
            made[key] = replace(base, zone_cost={**costs, **base.zone_cost, **closing, **shut})
        found[robot] = made[key]
    return found


def own_costs(book: TaskBook) -> OwnCosts:
    """Return what metres in zones count for single robots when the planner chooses their ways now.

    Args:
        book: Profiles, and the tasks that say which robots are loaded.
    """
    found: OwnCosts = {}
    for robot, entry in book.robots.items():
        profile = entry.profile
        if profile is None or not (profile.zone_cost or profile.loaded_zone_cost):
            continue
        costs = dict(profile.zone_cost)
        task = book.task_of(robot) if profile.loaded_zone_cost else None
        if task is not None and task.is_loaded:
            costs |= profile.loaded_zone_cost
        if costs:
            found[robot] = costs
    return found
