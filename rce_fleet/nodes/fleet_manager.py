"""The fleet manager as a node: tasks, goals, chargers and zones, kept in a journal, beside the planner.

The work is done by :mod:`rce_fleet.manager` and :mod:`rce_fleet.tasks`; this node passes messages to them and
from them. ``share/README.md`` lists topics, services and parameters.
"""

from __future__ import annotations

import asyncio
import json
import os
import re
import sys
import time
from collections import deque
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rce.aio.tasks import run_in_groups
from rce.ros.errors import ServiceTimeoutError
from rce.ros.node import MasterError, Message, Node, Publisher, RosError, ServiceClient, run
from rce.ros.tools.plain import plain
from rce.ros.types import TypesError
from rce_fleet.exceptions import JournalError, JournalInUseError
from rce_fleet.journal.journal import Journal
from rce_fleet.manager.cell_blocks import block_request
from rce_fleet.manager.fleet_routes import ROUTES as FLEET_ROUTES
from rce_fleet.manager.goals import NO_ANSWER
from rce_fleet.manager.manager import FleetManager
from rce_fleet.manager.requests import FleetRequest, Router
from rce_fleet.manager.task_routes import ROUTES as TASK_ROUTES
from rce_fleet.manager.zones import zone_fields
from rce_fleet.nodes import batch_worker
from rce_fleet.nodes.fleet_facts import FactKeeper
from rce_fleet.nodes.graph_look import GraphLook
from rce_fleet.nodes.grid_messages import GRID_TOPIC, read_grid
from rce_fleet.nodes.known_robots import VOLUME_VARIABLE
from rce_fleet.nodes.manager_parameters import ManagerParameters, rules_of
from rce_fleet.nodes.parameters import read_parameters
from rce_fleet.nodes.registering import ROBOTS_AT_ONCE
from rce_fleet.nodes.standby import serve_in_turn, stand_by, successor
from rce_fleet.nodes.task_loops import COMPILE_FROM, compile_beside
from rce_fleet.nodes.throttled_log import ThrottledLog
from rce_fleet.nodes.zone_messages import costs_fields
from rce_fleet.tasks.records import CellBlock, Places, Zone

if TYPE_CHECKING:
    from collections.abc import Callable

    from rce_fleet.tasks.zone_costs import OwnCosts

SERVICE = "/fleet/request"
"""Every fleet manager provides this service."""
BAD_JOURNAL = 2
"""Exit code of a manager that cannot open its journal."""
STEP_S = 0.2
"""Seconds between two steps."""
LOOK_AROUND_S = 2.0
"""Seconds between two searches for batteries, in a small graph."""
SILENT_S = 5.0
"""The planner publishes a change, or the number of the last one, every second. After this time without one,
its complete state is requested again."""
CALL_TIMEOUT_S = 5.0
BATTERY_TOPIC = re.compile(r"/([A-Za-z][A-Za-z0-9_]*)/battery_state")
SAME_PLANNER_S = 1.5
"""A list of requested cells counts once the same planner was heard so long after it: that of a planner that
was restarted, which begins empty, can come before the manager knows of the restart."""
MOST_LISTS = 1000
"""Most lists of requested cells that wait until they count."""


class PlannerServices:
    """The planner's services.

    Args:
        node: A running node.
        on_silence: Called when the planner did not answer in time.
    """

    def __init__(self, node: Node, on_silence: Callable[[], None] = lambda: None) -> None:
        self._on_silence = on_silence
        self._set_goal = node.service_client("/fleet/set_goal", "fleet/SetGoal")
        self._block_cell = node.service_client("/fleet/block_cell", "fleet/BlockCell")
        self._set_costs = node.service_client("/fleet/set_costs", "fleet/SetCosts")
        self._set_mode = node.service_client("/fleet/set_mode", "fleet/SetMode")
        self._set_zones = node.service_client("/fleet/set_zones", "fleet/SetZones")

    async def set_goal(self, robot: str, cell: int | None) -> str:
        """Send a robot to a cell, or remove its goal; return why the planner refused."""
        return await self._call(self._set_goal, robot=robot, cell=-1 if cell is None else cell)

    async def block_cell(self, cell: int, block: CellBlock | None, now: float) -> str:
        """Block a cell, or free it (None); return why the planner refused.

        Args:
            cell: The cell.
            block: Who blocks it, and why.
            now: Seconds since 1970.
        """
        return await self._call(self._block_cell, **block_request(cell, block, now))

    async def set_mode(self, robot: str, mode: str, reason: str, user: str) -> str:
        """Set who drives a robot, or the fleet's mode (robot empty); return why the planner refused."""
        return await self._call(self._set_mode, robot=robot, mode=mode, reason=reason, by=user)

    async def set_zone(self, name: str, zone: Zone | None, now: float) -> str:
        """Make or replace a zone, or remove it (None); return why the planner refused.

        Args:
            name: Its name.
            zone: The zone.
            now: Seconds since 1970.
        """
        zones, remove = ([], [name]) if zone is None else ([zone_fields(zone, now)], [])
        return await self._call(self._set_zones, zones=zones, remove=remove, revision=-1)

    async def set_costs(self, costs: OwnCosts) -> str:
        """Set what metres in zones count for single robots; return why the planner refused."""
        return await self._call(self._set_costs, **costs_fields(costs))

    async def _call(self, client: ServiceClient, **request: Any) -> str:
        try:
            answer = await client.call(request, timeout=CALL_TIMEOUT_S)
        except (RosError, TypesError) as error:  # a request that has no message form gets no answer either
            if isinstance(error, ServiceTimeoutError):
                self._on_silence()
            return f"{NO_ANSWER}: {error}"
        return "" if answer.ok else str(answer.message)


class ManagerNode:
    """The manager in a ROS graph.

    Args:
        node: Running node.
        parameters: Its parameters.
        journal: Where everything is kept.

    Attributes:
        successor: The node of another manager that has taken over; empty: none has.
    """

    def __init__(self, node: Node, parameters: ManagerParameters, journal: Journal) -> None:
        self._node = node
        self._parameters = parameters
        self._journal = journal
        self._events: Publisher
        self._batteries: set[str] = set()
        self._wrong_batteries: set[str] = set()
        """Robots whose batteries say what cannot be: each is warned of once."""
        self._heard_at = 0.0
        self._state_needed = asyncio.Event()
        self._requested: deque[tuple[float, frozenset[int]]] = deque(maxlen=MOST_LISTS)
        self._manager: FleetManager
        self._facts: FactKeeper
        self.successor = ""

    async def run(self) -> None:
        """Run until the node is stopped, or another manager has taken over."""
        node = self._node
        self._events = await node.advertise("/fleet/events", "std_msgs/String")
        self._manager = FleetManager(
            self._journal,
            PlannerServices(node, self._miss_planner),
            rules_of(self._parameters),
            node.log,
            publish=self._publish,
        )
        self._facts = FactKeeper(self._manager.facts)
        self._state_needed.set()
        try:
            await self._serve()
        finally:
            await self._manager.close()

    async def _serve(self) -> None:
        """Answer requests, and let tasks be done, until the node is stopped or replaced."""
        node = self._node
        await self._set_places()
        router = Router(self._manager, [*TASK_ROUTES, *FLEET_ROUTES])

        async def answer(request: Message) -> dict[str, Any]:
            said = await router.answer(
                FleetRequest(
                    *(request.method.upper(), request.path, request.body, request.user, request.role),
                    *(request.key, request.revision),
                )
            )
            return {"status": said.status, "body": said.body, "revision": said.revision}

        await node.subscribe("/fleet/changes", "fleet/FleetChanges", self._take_changes)
        await node.subscribe("/fleet/requestedCells", "std_msgs/Int32MultiArray", self._take_requested)
        await node.advertise_service(SERVICE, "fleet/Request", answer)
        node.log.info("the fleet manager has %d open tasks", self._manager.book.open_count)
        async with asyncio.TaskGroup() as tasks:
            others = [tasks.create_task(self._follow_planner()), tasks.create_task(self._look_around())]
            if (every := self._parameters.improve_every) and batch_worker.is_available():
                others.append(tasks.create_task(batch_worker.improve_queues(self._manager, node.log, every)))
            is_compiling = False
            while not self.successor and await node.sleep(STEP_S):
                await self._step()
                if not is_compiling and len(self._manager.facts.robots) >= COMPILE_FROM:
                    is_compiling = True
                    others.append(tasks.create_task(compile_beside(node.log)))
            for other in others:
                other.cancel()

    def _miss_planner(self) -> None:
        """Send the planner nothing until its whole state has come: each call would wait for an answer."""
        self._manager.facts.is_live = False
        self._state_needed.set()

    async def _step(self) -> None:
        if time.monotonic() - self._heard_at > SILENT_S:
            self._miss_planner()
        while self._requested and self._heard_at - self._requested[0][0] > SAME_PLANNER_S:
            self._manager.facts.requested = self._requested.popleft()[1]
        await self._manager.step()

    async def _set_places(self) -> None:
        """Take chargers and parking places of the parameters over, unless people have set others."""
        book, given = self._manager.book, self._parameters
        places = Places(tuple(given.chargers), tuple(given.parking), tuple(given.return_cells))
        if book.places.revision == 0 and places != Places():
            book.emit(
                places, "places", self._manager.clock(), text="chargers and parking places of the parameters"
            )
            await self._manager.commit()

    def _publish(self, events: list[dict[str, Any]]) -> None:
        for event in events:
            self._events.publish(data=json.dumps({**event, "journal": self._journal.id}))

    # The planner

    def _take_changes(self, message: Message) -> None:
        change = plain(message)
        if change["started"] == self._facts.started:
            self._heard_at = time.monotonic()
        self._facts.take_changes(change, self._manager.clock())
        if self._facts.is_behind:
            self._state_needed.set()

    def _take_requested(self, message: Message) -> None:
        """Take over which cells people blocked at the planner."""
        newest = time.monotonic(), frozenset(message.data)
        if len(self._requested) == MOST_LISTS:
            self._requested.pop()  # not the oldest: lists that come without a pause must count some time
        self._requested.append(newest)

    async def _follow_planner(self) -> None:
        """Request the planner's complete state whenever it is needed."""
        client = self._node.service_client("/fleet/get_state", "fleet/GetState")
        throttled = ThrottledLog(self._node)
        while True:
            await self._state_needed.wait()
            self._state_needed.clear()
            try:
                answer = await client.call({}, timeout=CALL_TIMEOUT_S)
            except (RosError, TypesError) as error:
                throttled.warn("planner", f"the planner does not answer: {error}")
                self._state_needed.set()
                await asyncio.sleep(1.0)
                continue
            state = plain(answer)
            if not self._facts.knows_rotation(state):
                self._manager.facts.is_live = False  # cells may have other numbers than in the state before
                if not await self._read_rotation(state):
                    throttled.warn("grid", f"the planner's grid does not come on {GRID_TOPIC}")
                self._state_needed.set()
                continue
            self._heard_at = time.monotonic()
            if self._facts.take_state(state, self._manager.clock()):
                self._begin()

    async def _read_rotation(self, state: dict[str, Any]) -> bool:
        """Wait until it is known how the grid of a state is turned; return whether it is.

        The grid is received once for each start of the planner: each blocked cell publishes it anew.
        """
        came = asyncio.Event()

        def take(message: Message) -> None:
            made = message.info.map_load_time
            try:
                self._facts.take_rotation({"secs": made.secs, "nsecs": made.nsecs}, read_grid(message).yaw)
            except ValueError as error:
                self._node.log.warning("the planner's grid on %s cannot be read: %s", GRID_TOPIC, error)
            if self._facts.knows_rotation(state):
                came.set()

        grid = await self._node.subscribe(GRID_TOPIC, "nav_msgs/OccupancyGrid", take)
        try:
            async with asyncio.timeout(CALL_TIMEOUT_S):
                await came.wait()
        except TimeoutError:
            return False
        finally:
            await grid.close()
        return True

    def _begin(self) -> None:
        """Begin with a planner that was started, or is heard for the first time."""
        self._manager.planner_began(self._facts.run)
        if self._manager.facts.requested is not None:
            self._requested.clear()  # of the planner before

    # Batteries

    async def _look_around(self) -> None:
        """Subscribe to the battery of every robot."""
        async with GraphLook(self._node, LOOK_AROUND_S) as graph:
            while True:
                try:
                    topics = await graph.look()
                    self.successor = successor(self._node, topics, SERVICE)
                    found = filter(None, map(BATTERY_TOPIC.fullmatch, topics.publishers))
                    new = [robot[1] for robot in found if robot[1] not in self._batteries]
                    await run_in_groups(
                        [partial(self._follow_battery, robot) for robot in new], ROBOTS_AT_ONCE
                    )
                except MasterError as error:
                    self._node.log.warning("cannot search for batteries: %s", error)
                await asyncio.sleep(graph.pause)

    async def _follow_battery(self, robot: str) -> None:
        def take(message: Message) -> None:
            capacity = message.capacity if message.capacity > 0 else message.design_capacity
            fault = self._facts.take_battery(
                robot, message.percentage, message.charge, capacity, message.power_supply_status
            )
            if fault and robot not in self._wrong_batteries:
                self._node.log.warning("/%s/battery_state: %s", robot, fault)
            (self._wrong_batteries.add if fault else self._wrong_batteries.discard)(robot)

        await self._node.subscribe(f"/{robot}/battery_state", "sensor_msgs/BatteryState", take)
        self._batteries.add(robot)


def open_journal(given: str) -> Journal:
    """Open the journal in a file, or in a folder; without a name in the home of this machine's user.

    Raises:
        JournalError: It cannot be opened.
        OSError: Its folder cannot be made.
    """
    path = Path(given).expanduser() if given else Path.home() / "fleet"
    if path.is_dir() or not path.suffix:
        path = path / "journal.sqlite"
    path.parent.mkdir(parents=True, exist_ok=True)
    return Journal(path)


async def main() -> int:
    """Run the manager until the node is stopped; return the program's exit code."""
    return await serve_in_turn(serve)


async def serve() -> int | None:
    """Run the manager once; return the program's exit code, or None if another manager has taken over."""
    async with Node("fleet_manager") as node:
        parameters = await read_parameters(node, ManagerParameters)
        turn = await stand_by(node, "fleet manager", SERVICE, then="opens its journal")
        if not turn.is_due:
            return 0
        place = parameters.journal or os.environ.get(VOLUME_VARIABLE, "")
        if not place:
            node.log.warning(
                "tasks are kept in the home of this container: they survive the end of this node, and are"
                " lost with the container; give the container a volume with the name fleet"
            )
        try:
            journal = await asyncio.to_thread(open_journal, place)
        except (JournalError, OSError) as error:
            is_held = isinstance(error, JournalInUseError) and turn.predecessor
            reason = f"{error}. It may be hung: {turn.predecessor}" if is_held else str(error)
            node.log.error("the fleet manager cannot start: %s", reason)  # noqa: TRY400 - it says it all
            print(f"fleet_manager: {reason}", file=sys.stderr)  # noqa: T201
            return BAD_JOURNAL
        manager = ManagerNode(node, parameters, journal)
        await manager.run()
        if not manager.successor:
            return 0
        node.log.error(
            "the fleet manager %s has taken over this fleet: this one stops, and stands by", manager.successor
        )
    return None


if __name__ == "__main__":
    sys.exit(run(main()))
