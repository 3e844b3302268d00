"""Reads and writes ``fleet/Zone``; reads the requests ``fleet/SetZones``, ``SetCosts`` and ``SetMode``."""

from __future__ import annotations

from enum import Enum
from math import inf
from typing import TYPE_CHECKING, Any, TypeVar

from rce_fleet.coordination.events import CostsSet, ModeSet, ZonesSet
from rce_fleet.coordination.modes import read_mode
from rce_fleet.coordination.zones import Direction, Zone, ZoneKind
from rce_fleet.exceptions import ZoneError
from rce_fleet.limits import MOST_LIFETIME

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rce.ros.types import Message

E = TypeVar("E", bound=Enum)


def read_zone(message: Message, now: float) -> Zone:
    """Return the zone of a ``fleet/Zone``.

    Args:
        message: The message.
        now: The planner's time, seconds.

    Raises:
        ZoneError: A field has a value that no zone has.
    """
    where = f"zone {message.id!r}"
    if len(message.edges) % 2:
        raise ZoneError(
            f"{where}: edges are pairs of cells, and {len(message.edges)} is an odd number of cells"
        )
    if not 0 <= message.lifetime <= MOST_LIFETIME:
        raise ZoneError(f"{where}: its lifetime must be 0 .. {MOST_LIFETIME:g} s, not {message.lifetime}")
    edges = zip(message.edges[::2], message.edges[1::2], strict=True)
    return Zone(
        id=message.id,
        kind=_member(ZoneKind, message.kind, f"{where}: kind"),
        cells=tuple(sorted(set(message.cells))),
        edges=tuple(sorted(set(edges))),
        robots=tuple(sorted(set(message.robots))),
        speed=message.speed,
        direction=_member(Direction, message.direction, f"{where}: direction") if message.direction else None,
        capacity=message.capacity,
        cost=message.cost,
        reason=message.reason,
        by=message.by,
        expires=now + message.lifetime if message.lifetime else inf,
    )


def zone_fields(zone: Zone, now: float) -> dict[str, Any]:
    """Return the fields of a ``fleet/Zone``.

    Args:
        zone: The zone.
        now: The planner's time, seconds.
    """
    return {
        "id": zone.id,
        "kind": zone.kind.value,
        "cells": list(zone.cells),
        "edges": [cell for edge in zone.edges for cell in edge],
        "robots": list(zone.robots),
        "speed": zone.speed,
        "direction": zone.direction.value if zone.direction else "",
        "capacity": zone.capacity,
        "cost": zone.cost,
        "reason": zone.reason,
        "by": zone.by,
        "lifetime": max(zone.expires - now, 0.001) if zone.expires < inf else 0.0,
    }


def read_zones_set(request: Message, now: float) -> ZonesSet:
    """Return the event of a ``fleet/SetZones`` request.

    Raises:
        ZoneError: A zone cannot be read.
    """
    return ZonesSet(
        zones=tuple(read_zone(zone, now) for zone in request.zones),
        remove=tuple(request.remove),
        replace=request.replace,
        revision=None if request.revision < 0 else request.revision,
    )


def read_costs_set(request: Message) -> CostsSet:
    """Return the event of a ``fleet/SetCosts`` request.

    Raises:
        ZoneError: Its lists have different lengths.
    """
    lengths = len(request.robots), len(request.zones), len(request.costs)
    if len(set(lengths)) > 1:
        found = ", ".join(map(str, lengths))
        raise ZoneError(f"robots, zones and costs must have as many entries each, not {found}")
    costs: dict[str, dict[str, float]] = {}
    for robot, zone, factor in zip(request.robots, request.zones, request.costs, strict=True):
        costs.setdefault(robot, {})[zone] = factor
    return CostsSet(costs)


def costs_fields(costs: Mapping[str, Mapping[str, float]]) -> dict[str, Any]:
    """Return the fields of a ``fleet/SetCosts`` request.

    Args:
        costs: How much a metre counts, by robot and id of the zone.
    """
    rows = [(robot, zone, factor) for robot, own in costs.items() for zone, factor in own.items()]
    return {
        "robots": [robot for robot, _, _ in rows],
        "zones": [zone for _, zone, _ in rows],
        "costs": [factor for _, _, factor in rows],
    }


def read_mode_set(request: Message) -> ModeSet:
    """Return the event of a ``fleet/SetMode`` request.

    Raises:
        ValueError: There is no such mode.
    """
    return ModeSet(request.robot or None, read_mode(request.mode), request.reason, request.by)


def _member(kind: type[E], text: str, where: str) -> E:
    """Return the member of an enumeration with a value.

    Raises:
        ZoneError: There is none.
    """
    try:
        return kind(text)
    except ValueError:
        known = ", ".join(str(member.value) for member in kind)
        raise ZoneError(f"{where} must be one of {known}, not {text!r}") from None
