"""Plans for a fleet: grants each robot cells of the map, so that no two robots ever claim the same one.

A robot is found by its topic ``/NAME/amcl_pose`` and needs a move client. The work is done by
:mod:`rce_fleet.coordination`; this node passes messages to it and from it. ``share/README.md`` lists
topics and parameters.
"""

from __future__ import annotations

import asyncio
import gc
import re
import sys
import time
from functools import partial
from typing import TYPE_CHECKING, Any, assert_never

from rce.own_process import collect_all_seldom
from rce.ros.errors import MasterError
from rce.ros.node import Node, run
from rce.ros.node.running import stop_signals
from rce_fleet.coordination.events import (
    BlockedChanged,
    CellBlocked,
    CellsIgnored,
    Event,
    GoalSet,
    Instruction,
    MakePlan,
    PlanMade,
    Reply,
    RobotRemoved,
    RobotsExpected,
    SendCancel,
    SendCells,
    Tick,
)
from rce_fleet.coordination.grid_change import next_planner, refuse_grid
from rce_fleet.coordination.planner import FleetPlanner
from rce_fleet.coordination.planner_watch import OtherPlanner, PlannerWatch
from rce_fleet.coordination.settings import FleetSettings
from rce_fleet.exceptions import LanesError, MapError, PlannerError, ZoneError
from rce_fleet.nodes.block_messages import read_cell_request
from rce_fleet.nodes.graph_look import GraphLook
from rce_fleet.nodes.grid_choice import CHOSEN, GridChoice, GridChooser
from rce_fleet.nodes.grid_messages import GRID_TOPIC, grid_name
from rce_fleet.nodes.grid_parameters import make_grid, read_fleet_parameters, unknown_parameters
from rce_fleet.nodes.grid_topics import GridTopics
from rce_fleet.nodes.known_robots import KnownRobots, file_of_robots, uptime
from rce_fleet.nodes.plan_worker import PlanWorker
from rce_fleet.nodes.planner_parameters import KNOWN, read_lane_graph, read_settings
from rce_fleet.nodes.pose_publisher import PosePublisher
from rce_fleet.nodes.robot_topics import RobotTopics
from rce_fleet.nodes.standby import serve_in_turn, stand_by, successor
from rce_fleet.nodes.state_publisher import GET_STATE, GET_STATE_SERVICE, StatePublisher
from rce_fleet.nodes.throttled_log import ThrottledLog
from rce_fleet.nodes.zone_messages import read_costs_set, read_mode_set, read_zones_set
from rce_fleet.planning.planner import INDEPENDENT

if TYPE_CHECKING:
    from rce.ros.node import Service
    from rce.ros.node.service import Handler
    from rce.ros.types import Message
    from rce_fleet.coordination.replanning import PlanRequest
    from rce_fleet.nodes.graph_look import GraphState
    from rce_fleet.planning.grid import GridMap

TICK = 0.1
"""Seconds between two timer events; changes of the state are published at most this often."""
LOOK_AROUND = 0.5
"""Seconds between two searches for new robots, in a small graph."""
KEEP_EVERY = 1.0
"""Seconds between two looks whether robots have other cells than those kept for the next planner."""
SERVICE = "/fleet/set_goal"
"""Every planner provides this service."""
STOPPED = "%s: this planner has stopped; end one of the two, then start this one again"
REMIND_EVERY = 60.0
"""Seconds after which a planner that stopped because of another one says so again."""
BAD_PARAMETERS = 2
"""Exit code of a planner that cannot start with its parameters."""
GRID_OF_LANES = (
    "the lanes are made for the present cells: change the file of lanes, and start the planner again"
)
ROBOT_TOPIC = re.compile(r"/([A-Za-z][A-Za-z0-9_]*)/amcl_pose")
CLIENT_TOPIC = re.compile(r"/([A-Za-z][A-Za-z0-9_]*)/moveClient/status")


class PlannerNode:
    """The planner in a ROS graph.

    Args:
        node: Running node.
        planner: The planner.
        chooser: Makes other grids over its map; if None, over the planner's grid.
        takes_answers: Move clients answer on ``goalNodesList`` instead of their own topics.
        known: Keeps robots for the planner after this one.

    Attributes:
        successor: The node of another planner that has taken over; empty: none has.
        other: A newer planner in another ROS graph, which drives robots of this one; None: not found.
    """

    def __init__(
        self,
        node: Node,
        planner: FleetPlanner,
        chooser: GridChooser | None = None,
        *,
        takes_answers: bool = False,
        known: KnownRobots | None = None,
    ) -> None:
        self._chooser = chooser or GridChooser({}, planner.state.grid)
        self._node = node
        self._takes_answers = takes_answers
        self._planner = planner
        self._requests: asyncio.Queue[tuple[FleetPlanner, PlanRequest]] = asyncio.Queue()
        self._state = StatePublisher(node, planner)
        self._poses = PosePublisher(node)
        self._watch = PlannerWatch(grid_name(self._state.started))
        self._robots = RobotTopics(
            *(node, self._handle, self._poses),
            takes_answers=takes_answers,
            hear_planner=self._hear_planner,
        )
        self._grid = GridTopics(node)
        self._known = known
        self._services: dict[str, tuple[str, Handler, Service]] = {}
        self._throttled_log = ThrottledLog(node)
        self.successor = ""
        self.other: OtherPlanner | None = None

    @property
    def is_replaced(self) -> bool:
        """Whether another planner drives the fleet now."""
        return bool(self.successor) or self.other is not None

    async def run(self, blocked: list[int]) -> None:
        """Run until the node is stopped, or another planner has taken over.

        Args:
            blocked: Cells that are blocked at the start, and can be freed.
        """
        node = self._node
        await self._grid.start()
        self._publish_blocked(())
        await self._expect_known()
        for cell in blocked:
            self._handle(CellBlocked(cell, reason="parameter of the planner"))
        await self._provide(SERVICE, "fleet/SetGoal", self._set_goal)
        await self._provide("/fleet/block_cell", "fleet/BlockCell", self._block_cell)
        await self._provide("/fleet/remove_robot", "fleet/RemoveRobot", self._remove_robot)
        await self._provide("/fleet/set_zones", "fleet/SetZones", self._set_zones)
        await self._provide("/fleet/set_costs", "fleet/SetCosts", self._set_costs)
        await self._provide("/fleet/set_mode", "fleet/SetMode", self._set_mode)
        await self._provide("/fleet/set_grid", "fleet/SetGrid", self._set_grid)
        await self._poses.start()
        await self._state.start()  # last: who sees the state may call the services
        self._services[GET_STATE_SERVICE] = GET_STATE, self._state.get_state, self._state.service
        timeout = self._planner.settings.plan_timeout
        async with PlanWorker(node.log, timeout=timeout) as worker, asyncio.TaskGroup() as tasks:
            planning = tasks.create_task(self._make_plans(worker))
            tasks.create_task(self._look_around())
            tasks.create_task(self._keep_known())
            # Modules, message types and the map stay: no garbage collection between two ticks looks at them.
            gc.collect()
            gc.freeze()
            collect_all_seldom()
            await self._keep_time(worker)
            if self.other is not None:
                self._stop_own()
            planning.cancel()

    async def _provide(self, name: str, kind: str, answer: Handler) -> None:
        self._services[name] = kind, answer, await self._node.advertise_service(name, kind, answer)

    async def _provide_again(self, graph: GraphState) -> None:
        """Take services back that are registered for another planner, which started at the same moment.

        It stops, because this one has :data:`SERVICE`, and takes its registrations along.
        """
        own = self._node.name
        for name, (kind, answer, service) in list(self._services.items()):
            if own in graph.services.get(SERVICE, ()) and own not in graph.services.get(name, ()):
                await service.close()
                await self._provide(name, kind, answer)

    # Robots

    async def _expect_known(self) -> None:
        """Wait for the robots that the planner before this one knew, and for those of the ROS graph."""
        expected: dict[str, tuple[int, ...]] = {}
        async with GraphLook(self._node, LOOK_AROUND) as graph:
            try:
                topics = list((await graph.look()).publishers)
            except MasterError as error:
                self._node.log.warning("cannot search for robots: %s", error)
                topics = []
        for topic in topics:
            found = ROBOT_TOPIC.fullmatch(topic) or CLIENT_TOPIC.fullmatch(topic)
            if found is not None:
                expected[found[1]] = ()
        if self._known is not None:
            try:
                robots, remark = self._known.read(self._planner.state.grid, uptime())
                expected |= robots
                if remark:
                    self._node.log.warning("%s", remark)
            except (OSError, ValueError) as error:
                self._node.log.warning("robots of an earlier planner are not known: %s", error)
        if expected:
            self._handle(RobotsExpected(expected))

    async def _keep_known(self) -> None:
        """Write the robots and their cells, if they changed, beside the planner's work."""
        while self._known is not None and not self.is_replaced and await self._node.sleep(KEEP_EVERY):
            content = self._known.content(self._planner.state, uptime())
            if content is None:
                continue
            try:
                await asyncio.to_thread(self._known.write, content, uptime())
            except OSError as error:
                self._throttled_log.warn("known", f"robots cannot be kept for the next planner: {error}")

    async def _look_around(self) -> None:
        """Add every robot whose pose is published."""
        async with GraphLook(self._node, LOOK_AROUND) as graph:
            while True:
                try:
                    topics = await graph.look()
                    self.successor = successor(self._node, topics, SERVICE)
                    if self.is_replaced:
                        return
                    await self._provide_again(topics)
                    found = filter(None, map(ROBOT_TOPIC.fullmatch, topics.publishers))
                    await self._robots.join(robot[1] for robot in found if robot[1] not in self._robots)
                    await self._grid.serve_old_topic(topics, self._planner.state, self._state.started)
                except MasterError as error:
                    self._node.log.warning("cannot search for robots: %s", error)
                if not await self._node.sleep(graph.pause):
                    return

    def _hear_planner(self, robot: str, planner: str) -> None:
        """Take the planner that a move client reports; one that is newer than this one replaces it."""
        other = self._watch.take(robot, planner, time.monotonic())
        if other is None:
            return
        if other.is_newer:
            self.other = other
        else:
            text = f"{describe(other)}; it is the older one and should stop by itself: if it does not, end it"
            self._throttled_log.warn("planner", text)

    def _stop_own(self) -> None:
        """Stop the robots that the other planner does not drive: it does not know which cells they have."""
        for robot in self._planner.state.robots:
            if not self._watch.is_with_other(robot):
                self._robots.send_cancel(robot)
        self._robots.fall_silent()

    # What comes in

    async def _keep_time(self, worker: PlanWorker) -> None:
        while await self._node.sleep(TICK) and not self.is_replaced:
            if self._planner.settings.planner != INDEPENDENT:  # that one asks for a plan after deadlocks only
                robots = max(len(self._planner.state.robots), len(self._planner.expected))
                worker.prepare(robots, len(self._planner.state.grid))
            self._handle(Tick())
            self._state.update(time.monotonic())
            self._poses.update(self._planner.state.robots, time.monotonic())
            clients = self._robots.client_grids
            grids = [clients[robot] for robot in self._planner.state.robots if robot in clients]
            self._grid.send_again(self._planner.state, self._state.started, grids)

    async def _make_plans(self, worker: PlanWorker) -> None:
        while True:
            planner, request = await self._requests.get()
            result = await worker.compute(request)
            if planner is self._planner:  # else the grid was changed meanwhile
                self._handle(PlanMade(result))

    def _set_goal(self, request: Message) -> dict[str, Any]:
        return self._ask(GoalSet(request.robot, None if request.cell < 0 else request.cell))

    def _block_cell(self, request: Message) -> dict[str, Any]:
        try:
            return self._ask(read_cell_request(request, time.monotonic()))
        except ValueError as error:
            return {"ok": False, "message": str(error)}

    def _remove_robot(self, request: Message) -> dict[str, Any]:
        return self._ask(RobotRemoved(request.robot))

    def _set_zones(self, request: Message) -> dict[str, Any]:
        try:
            reply = self._ask(read_zones_set(request, time.monotonic()))
        except ZoneError as error:
            reply = {"ok": False, "message": str(error)}
        return {**reply, "revision": self._planner.state.zones.revision}

    def _set_costs(self, request: Message) -> dict[str, Any]:
        try:
            return self._ask(read_costs_set(request))
        except ZoneError as error:
            return {"ok": False, "message": str(error)}

    def _set_mode(self, request: Message) -> dict[str, Any]:
        try:
            return self._ask(read_mode_set(request))
        except ValueError as error:
            return {"ok": False, "message": str(error)}

    async def _set_grid(self, request: Message) -> dict[str, Any]:
        if self._planner.state.zones.lanes is not None:
            return {"ok": False, "message": GRID_OF_LANES}
        choice = self._chooser.read(request)
        reply, grid = await self._chooser.answer(choice, self._refuse_grid, preview=request.preview)
        if grid is not None:
            await self._take_grid(grid, choice)
        return reply

    def _refuse_grid(self, grid: GridMap) -> str:
        """Return why the fleet cannot change to a grid now; empty if it can."""
        if self._takes_answers:
            return (
                "the move clients have the grid from their parameters (answers): restart them and the planner"
            )
        own = grid_name(self._state.started)
        for robot in sorted(self._planner.state.robots):
            if self._robots.client_grids.get(robot, own) != own:
                return f"the move client of {robot} does not take its grid from {GRID_TOPIC}"
        return refuse_grid(self._planner, grid)

    async def _take_grid(self, grid: GridMap, choice: GridChoice) -> None:
        """Begin anew with another grid: first the grid is published, then the state and lists of it."""
        self._planner, instructions = next_planner(self._planner, grid, time.monotonic())
        self._robots.ignore_old_cells()
        self._chooser.blocked_share = choice.blocked_share
        self._state.restart(self._planner)
        self._watch.rename(grid_name(self._state.started))
        self._publish_blocked(tuple(sorted(self._planner.state.blocked)))
        self._carry_out(instructions)
        self._state.publish_whole()
        self._node.log.info("the fleet has a new grid of cells of %g m", grid.cell_size)
        await self._node.set_param(f"~{CHOSEN}", self._chooser.stored(choice))

    # What goes out

    def _ask(self, event: Event) -> dict[str, Any]:
        """Pass a request to the planner; return the fields of the response."""
        reply = next(done for done in self._handle(event) if isinstance(done, Reply))
        self._node.log.info("%s", reply.message)
        self._grid.publish_requested(self._planner.state)
        return {"ok": reply.ok, "message": reply.message}

    def _handle(self, event: Event) -> list[Instruction]:
        """Pass an event to the planner and carry out its instructions."""
        instructions = self._planner.handle(event, time.monotonic())
        self._carry_out(instructions)
        return instructions

    def _carry_out(self, instructions: list[Instruction]) -> None:
        for instruction in instructions:
            match instruction:
                case SendCells():
                    self._robots.send_cells(instruction, grid_name(self._state.started))
                case SendCancel(robot):
                    self._robots.send_cancel(robot)
                case BlockedChanged(cells):
                    self._grid.change(cells)
                case MakePlan(request):
                    self._requests.put_nowait((self._planner, request))
                case CellsIgnored(robot, reason):
                    text = f"cells that {robot} reports blocked or free are ignored: {reason}"
                    self._throttled_log.warn(f"cells of {robot}", text)
                case Reply():
                    pass  # for the caller
                case _:
                    assert_never(instruction)
        self._grid.update(self._planner.state, self._state.started)

    def _publish_blocked(self, cells: tuple[int, ...]) -> None:
        self._grid.publish(self._planner.state, self._state.started, cells)


def describe(other: OtherPlanner) -> str:
    """Return which planner drives a robot of this one, for people."""
    began = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(other.began))
    name = f"it began at {began}, {other.name}"
    return f"another planner, in another ROS graph, drives {other.robot} too ({name})"


async def stay_away(other: OtherPlanner, signals: list[str]) -> int:
    """Do nothing until the node is stopped, and say why again and again; return the exit code.

    A planner that began again would be the newer one: then the other would stop, and so on.
    """
    told_at = time.monotonic()
    async with Node("fleet_planner") as node:
        while not signals and await node.sleep(1.0):  # one may come between two nodes
            if time.monotonic() - told_at >= REMIND_EVERY:
                told_at = time.monotonic()
                node.log.error(STOPPED, describe(other))
    return 0


def warn_of_size(node: Node, grid: GridMap, settings: FleetSettings) -> None:
    """Refuse robots that are bigger than a cell; warn if they are a little too big.

    Raises:
        MapError: A robot does not fit into a cell.
    """
    size, radius = grid.cell_size, settings.robot_radius
    if 2 * radius > size:
        raise MapError(
            f"robots with a radius of {radius:g} m do not fit into cells of {size:g} m: choose cells of at"
            f" least {2 * (radius + settings.arrival_tolerance):.2f} m, or set robot_radius"
        )
    if 2 * (radius + settings.arrival_tolerance) > size + 1e-9:
        node.log.warning(
            "cells of %g m are small for robots with a radius of %g m: one that stands %g m off its cell's"
            " centre also claims the cell beside it",
            size,
            radius,
            settings.arrival_tolerance,
        )


async def main() -> int:
    """Run the planner until the node is stopped; return the program's exit code."""
    signals: list[str] = []
    with stop_signals(signals.append):
        return await serve_in_turn(partial(serve, signals))


async def serve(signals: list[str]) -> int | None:
    """Run the planner once; return the program's exit code, or None if another planner has taken over.

    Args:
        signals: Why the program shall end, once it shall.
    """
    async with Node("fleet_planner") as node:
        values = await read_fleet_parameters(node)
        for remark in unknown_parameters(values, KNOWN):
            node.log.warning("%s", remark)
        try:
            settings = read_settings(values)
            first = make_grid(values)
            lanes, remarks = read_lane_graph(values, first, settings.robot_radius)
            chooser = GridChooser(values, first if lanes is None else lanes.restrict(first))
            takes_answers = bool(values.get("answers", False))
            is_fixed = takes_answers or lanes is not None
            grid, remark = await chooser.grid_at_start(None if is_fixed else values.get(CHOSEN))
            blocked = chooser.blocked_at_start(grid)
        except (ValueError, LanesError, MapError, PlannerError, OSError) as error:
            # With another map or other sizes than those that were meant, robots would not be safe.
            node.log.error("the planner cannot start: %s", error)  # noqa: TRY400 - a user's mistake
            print(f"fleet_planner: {error}", file=sys.stderr)  # noqa: T201
            return BAD_PARAMETERS
        warn_of_size(node, grid, settings)
        if not (await stand_by(node, "planner", SERVICE)).is_due:
            return 0
        for text in filter(None, (remark, *remarks)):
            node.log.warning("%s", text)
        file = file_of_robots(values)
        kept = KnownRobots(file, settings.ahead) if file is not None else None
        made = FleetPlanner(grid, settings, lanes=lanes)
        planner = PlannerNode(node, made, chooser, takes_answers=takes_answers, known=kept)
        await planner.run(blocked)
        if node.is_shutdown or not planner.is_replaced:
            return 0
        if planner.other is not None:
            node.log.error(STOPPED, describe(planner.other))
        else:
            node.log.error(
                "the planner %s has taken over this fleet: this one stops, and stands by", planner.successor
            )
    return None if planner.other is None else await stay_away(planner.other, signals)


if __name__ == "__main__":
    sys.exit(run(main()))
