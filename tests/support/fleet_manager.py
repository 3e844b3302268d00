"""A fleet manager with a journal and a planner, and a client that sends it requests."""

from __future__ import annotations

import json
import logging
from pathlib import Path
from typing import Any

from rce_fleet.journal.journal import Journal
from rce_fleet.manager.cell_blocks import block_request
from rce_fleet.manager.fleet_routes import ROUTES as FLEET_ROUTES
from rce_fleet.manager.manager import FleetManager
from rce_fleet.manager.requests import FleetRequest, Router
from rce_fleet.manager.task_routes import ROUTES as TASK_ROUTES
from rce_fleet.manager.zones import zone_fields
from rce_fleet.planning.grid import GridMap
from rce_fleet.tasks.dispatch import TaskRules
from rce_fleet.tasks.records import CellBlock, Zone
from rce_fleet.tasks.zone_costs import OwnCosts

GO = {"stops": [{"cell": 5}]}


class Planner:
    """Accepts all goals."""

    def __init__(self) -> None:
        self.goals: dict[str, int | None] = {}
        self.calls: list[tuple[Any, ...]] = []
        self.requests: list[dict[str, Any]] = []
        """Requests to block or free cells, as the planner gets them."""
        self.costs: list[OwnCosts] = []
        self.refusal = ""

    async def set_goal(self, robot: str, cell: int | None) -> str:
        self.goals[robot] = cell
        return ""

    async def block_cell(self, cell: int, block: CellBlock | None, now: float) -> str:
        self.calls.append(("cell", cell, block is not None))
        self.requests.append(block_request(cell, block, now))
        return self.refusal

    async def set_mode(self, robot: str, mode: str, reason: str, user: str) -> str:
        self.calls.append(("mode", robot, mode, reason, user))
        return self.refusal

    async def set_zone(self, name: str, zone: Zone | None, now: float) -> str:
        self.calls.append(("zone", name, None if zone is None else zone_fields(zone, now)["kind"]))
        return self.refusal

    async def set_costs(self, costs: OwnCosts) -> str:
        self.costs.append(costs)
        return self.refusal


class ManagerClient:
    """A manager with a journal, and a client of it."""

    def __init__(self, path: Path, planner: Planner | None = None) -> None:
        self.journal = Journal(path)
        self.planner = planner or Planner()
        self.manager = FleetManager(self.journal, self.planner, TaskRules(), logging.getLogger("manager"))
        self.manager.facts.grid = self.manager.book.grid = GridMap(blocked=frozenset({9}))
        self.manager.facts.shut = frozenset({9})
        self.manager.facts.is_live = True
        self.router = Router(self.manager, [*TASK_ROUTES, *FLEET_ROUTES])

    async def ask(self, method: str, path: str, body: Any = None, **fields: str) -> tuple[int, Any, str]:
        text = body if isinstance(body, str) else "" if body is None else json.dumps(body)
        given = {"user": "erp", "role": "operator", **fields}
        answer = await self.router.answer(FleetRequest(method, path, text, **given))
        return answer.status, json.loads(answer.body), answer.revision
