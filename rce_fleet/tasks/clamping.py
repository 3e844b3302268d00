"""Brings the numbers of records into their limits: journals of earlier releases hold any. Pure."""

from __future__ import annotations

from dataclasses import replace
from typing import assert_never

from rce_fleet.limits import (
    LEAST_CAPACITY,
    LEAST_FACTOR,
    LEAST_SPEED,
    MOST_AMOUNT,
    MOST_CELL,
    MOST_FACTOR,
    MOST_OCCURRENCES,
    MOST_ROOM,
    MOST_SPEED,
    MOST_TIME,
    within,
)
from rce_fleet.tasks.order import MOST_BETWEEN, Order
from rce_fleet.tasks.records import (
    BlockedCells,
    FleetEntry,
    GoalEntry,
    Places,
    PlannerRun,
    Record,
    RobotEntry,
    RobotProfile,
    Zone,
)
from rce_fleet.tasks.task import Task

ZONE_VALUES: dict[str, tuple[float, float]] = {
    "slow": (LEAST_SPEED, MOST_SPEED),
    "limited": (1.0, MOST_ROOM),
    "cost": (1.0, MOST_FACTOR),
}
"""Least and greatest value of a zone, by kind."""


def clamped(record: Record) -> Record:
    """Return a record with its numbers in their limits; the same one if they are.

    A stop or goal in a cell that no map has stays one in such a cell.
    """
    match record:
        case Task():
            recurs_at = None if record.recurs_at is None else within(record.recurs_at, 0.0, MOST_TIME)
            made: Record = replace(record, order=_order(record.order), recurs_at=recurs_at)
        case RobotEntry(profile=RobotProfile() as profile):
            made = replace(record, profile=_profile(profile))
        case GoalEntry(cell=int(cell)):
            made = replace(record, cell=_cell(cell))
        case Places():
            made = replace(
                record,
                chargers=_possible(record.chargers),
                parking=_possible(record.parking),
                returns=_possible(record.returns),
            )
        case Zone():
            made = _zone(record)
        case BlockedCells():
            made = _blocked(record)
        case RobotEntry() | GoalEntry() | FleetEntry() | PlannerRun():
            made = record
        case _:
            assert_never(record)
    return record if made == record else made


def _order(order: Order) -> Order:
    count = order.occurrences
    return replace(
        order,
        stops=tuple(replace(stop, cells=tuple(map(_cell, stop.cells))) for stop in order.stops),
        deadline=_time(order.deadline),
        earliest_start=_time(order.earliest_start),
        payload=within(order.payload, 0.0, MOST_AMOUNT),
        return_cells=tuple(map(_cell, order.return_cells)),
        every=None if order.every is None else within(order.every, 1.0, MOST_BETWEEN),
        occurrences=None if count is None else min(count, MOST_OCCURRENCES),
    )


def _profile(profile: RobotProfile) -> RobotProfile:
    return replace(
        profile,
        payload=within(profile.payload, 0.0, MOST_AMOUNT),
        speed=within(profile.speed, LEAST_SPEED, MOST_SPEED),
        capacity=within(profile.capacity, LEAST_CAPACITY, MOST_AMOUNT),
        drive=within(profile.drive, 0.0, MOST_AMOUNT),
        idle=within(profile.idle, 0.0, MOST_AMOUNT),
        acting=within(profile.acting, 0.0, MOST_AMOUNT),
        charging=within(profile.charging, LEAST_CAPACITY, MOST_AMOUNT),
        zone_cost=_factors(profile.zone_cost),
        loaded_zone_cost=_factors(profile.loaded_zone_cost),
    )


def _factors(costs: dict[str, float]) -> dict[str, float]:
    return {name: within(factor, LEAST_FACTOR, MOST_FACTOR) for name, factor in costs.items()}


def _zone(zone: Zone) -> Zone:
    value = zone.value
    if value is not None and zone.kind in ZONE_VALUES:
        value = within(value, *ZONE_VALUES[zone.kind])
    return replace(
        zone,
        value=value,
        cells=_possible(zone.cells),
        edges=tuple(edge for edge in zone.edges if _possible(edge) == edge),
        until=_time(zone.until),
    )


def _blocked(record: BlockedCells) -> BlockedCells:
    blocks = {
        cell: replace(block, since=_time(block.since), until=_time(block.until))
        for cell, block in record.blocks.items()
        if 0 <= cell <= MOST_CELL
    }
    return BlockedCells(_possible(record.cells), _possible(record.unsent), blocks)


def _time(seconds: float | None) -> float | None:
    return None if seconds is None else within(seconds, 0.0, MOST_TIME)


def _cell(cell: int) -> int:
    return cell if 0 <= cell <= MOST_CELL else MOST_CELL


def _possible(cells: tuple[int, ...]) -> tuple[int, ...]:
    return tuple(cell for cell in cells if 0 <= cell <= MOST_CELL)
