"""Plans for a fleet: grants each robot cells of the map, so that no two robots ever claim the same one.

A robot is found by its topic ``/NAME/amcl_pose`` and needs a move client. The work is done by
:mod:`rce_fleet.coordination`; this node passes messages to it and from it. ``share/README.md`` lists
topics and parameters.
"""

from __future__ import annotations

import asyncio
import re
import time
from typing import TYPE_CHECKING, Any, assert_never

from rce.ros.errors import MasterError
from rce.ros.node import Node, run
from rce.ros.node.master import MasterClient
from rce.ros.xmlrpc import RpcClient
from rce_fleet.coordination.answers import is_answer, numbered_array, read_answer
from rce_fleet.coordination.events import (
    BlockedChanged,
    CellBlocked,
    CellFreed,
    Event,
    GoalSet,
    Instruction,
    MakePlan,
    ObstacleGone,
    ObstacleSeen,
    PlanMade,
    PoseSeen,
    Reply,
    ReportSeen,
    RobotHeard,
    RobotRemoved,
    SendCancel,
    SendCells,
    Tick,
)
from rce_fleet.coordination.grid_change import next_planner, refuse_grid
from rce_fleet.coordination.planner import FleetPlanner
from rce_fleet.coordination.settings import FleetSettings
from rce_fleet.nodes.grid_choice import CHOSEN, GridChoice, GridChooser
from rce_fleet.nodes.grid_messages import (
    GRID_TOPIC,
    OLD_TOPIC,
    grid_fields,
    grid_name,
    wants_old_topic,
)
from rce_fleet.nodes.grid_parameters import make_grid, read_fleet_parameters
from rce_fleet.nodes.plan_worker import PlanWorker
from rce_fleet.nodes.robot_messages import read_pose_seen, read_report, read_sign
from rce_fleet.nodes.state_publisher import StatePublisher

if TYPE_CHECKING:
    from rce.ros.node import Publisher
    from rce.ros.types import Message
    from rce_fleet.coordination.move_client import ClientReport
    from rce_fleet.coordination.replanning import PlanRequest
    from rce_fleet.coordination.robot_signs import RobotSign
    from rce_fleet.planning.grid import GridMap

TICK = 0.1
"""Seconds between two timer events; changes of the state are published at most this often."""
LOOK_AROUND = 0.5
"""Seconds between two searches for new robots."""
POSE = "geometry_msgs/PoseWithCovarianceStamped"
ROBOT_TOPIC = re.compile(r"/([A-Za-z][A-Za-z0-9_]*)/amcl_pose")
OLD_CELLS_LAST = 3.0
"""Seconds after a change of the grid in which robots may report cells of the one before."""
OLD_TOPIC_LOOKS = 3
"""So many looks in a row must find only robot files from before on the old topic of the grid."""


class PlannerNode:
    """The planner in a ROS graph.

    Args:
        node: Running node.
        planner: The planner.
        chooser: Makes other grids over its map; if None, over the planner's grid.
        takes_answers: Move clients answer on ``goalNodesList`` instead of their own topics.
    """

    def __init__(
        self,
        node: Node,
        planner: FleetPlanner,
        chooser: GridChooser | None = None,
        *,
        takes_answers: bool = False,
    ) -> None:
        self._chooser = chooser or GridChooser({}, planner.state.grid)
        self._node = node
        self._takes_answers = takes_answers
        self._planner = planner
        self._cells: dict[str, Publisher] = {}
        self._cancels: dict[str, Publisher] = {}
        self._requests: asyncio.Queue[tuple[FleetPlanner, PlanRequest]] = asyncio.Queue()
        self._client_grids: dict[str, str] = {}
        """The grid that each robot's move client has; empty: it has one from its parameters."""
        self._obstacles_from = 0.0
        self._state = StatePublisher(node, planner)
        self._blocked: Publisher
        self._requested: Publisher
        self._map: Publisher
        self._old_map: Publisher | None = None
        self._shown_blocked: tuple[int, ...] = ()
        self._shown_requested: tuple[int, ...] | None = None
        self._looks_for_old = 0

    async def run(self, blocked: list[int]) -> None:
        """Run until the node is stopped.

        Args:
            blocked: Cells that are blocked at the start, and can be freed.
        """
        node = self._node
        self._blocked = await node.advertise("/fleet/blockedCells", "std_msgs/Int32MultiArray", latch=True)
        self._requested = await node.advertise(
            "/fleet/requestedCells", "std_msgs/Int32MultiArray", latch=True
        )
        self._map = await node.advertise(GRID_TOPIC, "nav_msgs/OccupancyGrid", latch=True)
        self._publish_blocked(())
        for cell in blocked:
            self._handle(CellBlocked(cell))
        await node.advertise_service("/fleet/set_goal", "fleet/SetGoal", self._set_goal)
        await node.advertise_service("/fleet/block_cell", "fleet/BlockCell", self._block_cell)
        await node.advertise_service("/fleet/remove_robot", "fleet/RemoveRobot", self._remove_robot)
        await node.advertise_service("/fleet/set_grid", "fleet/SetGrid", self._set_grid)
        await self._state.start()  # last: who sees the state may call the services
        async with PlanWorker(node.log) as worker, asyncio.TaskGroup() as tasks:
            planning = tasks.create_task(self._make_plans(worker))
            tasks.create_task(self._look_around())
            await self._keep_time()
            planning.cancel()

    # What comes in

    async def _look_around(self) -> None:
        """Add every robot whose pose is published."""
        async with RpcClient() as rpc:
            master = MasterClient(self._node.master_uri, self._node.name, self._node.uri, rpc)
            while True:
                try:
                    for topic, _ in await master.call("getPublishedTopics", ""):
                        found = ROBOT_TOPIC.fullmatch(topic)
                        if found is not None and found[1] not in self._cells:
                            await self._join(found[1])
                    await self._serve_old_topic(await master.call("getSystemState"))
                except MasterError as error:
                    self._node.log.warning("cannot search for robots: %s", error)
                if not await self._node.sleep(LOOK_AROUND):
                    return

    async def _serve_old_topic(self, state: list[Any]) -> None:
        """Publish the grid on the topic that robot files from before connect, while it has no other use."""
        publishers, subscribers = (dict(topics) for topics in state[:2])
        wanted = wants_old_topic(publishers, subscribers, self._node.name)
        self._looks_for_old = self._looks_for_old + 1 if wanted else 0
        if self._old_map is None and self._looks_for_old >= OLD_TOPIC_LOOKS:
            self._node.log.warning(
                "a robot file connects %s; the grid is now %s: change the file", OLD_TOPIC, GRID_TOPIC
            )
            self._old_map = await self._node.advertise(OLD_TOPIC, "nav_msgs/OccupancyGrid", latch=True)
            self._publish_blocked(self._shown_blocked)
        elif self._old_map is not None and set(publishers.get(OLD_TOPIC, ())) - {self._node.name}:
            old, self._old_map = self._old_map, None
            await old.close()

    async def _join(self, robot: str) -> None:
        node = self._node
        self._cells[robot] = await node.advertise(f"/{robot}/goalNodesList", "std_msgs/Int32MultiArray")
        self._cancels[robot] = await node.advertise(f"/{robot}/cancelGoal", "std_msgs/Bool")
        if self._takes_answers:
            await node.subscribe(
                f"/{robot}/goalNodesList",
                "std_msgs/Int32MultiArray",
                lambda message: self._take_answer(robot, message),
            )
        else:
            await self._hear_apart(robot)
        # Clients of the planner's container do not receive what its other interfaces publish.
        seen = await node.advertise(f"/fleet/poses/{robot}", POSE, latch=True)

        def take(message: Message) -> None:
            self._take(read_pose_seen(robot, message))
            seen.publish(message)

        await node.subscribe(f"/{robot}/amcl_pose", POSE, take)
        node.log.info("found robot %s", robot)

    async def _hear_apart(self, robot: str) -> None:
        """Subscribe to the topics of a move client and its robot."""
        await self._node.subscribe(
            f"/{robot}/moveClient/status",
            "fleet/MoveStatus",
            lambda message: self._take_status(robot, message),
        )
        await self._node.subscribe(
            f"/{robot}/blockedCells",
            "std_msgs/Int32MultiArray",
            lambda message: self._take_obstacle(ObstacleSeen(robot, tuple(message.data))),
        )
        await self._node.subscribe(
            f"/{robot}/freedCells",
            "std_msgs/Int32MultiArray",
            lambda message: self._take_obstacle(ObstacleGone(robot, tuple(message.data))),
        )

    def _take_answer(self, robot: str, message: Message) -> None:
        """Handle a move client's answer; the planner's own lists arrive here too."""
        dimensions = message.layout.dim
        labels = [dimension.label for dimension in dimensions]
        if not is_answer(labels):
            return
        try:
            answer = read_answer(labels, [dimension.size for dimension in dimensions], message.data)
        except ValueError as error:
            self._node.log.warning("%s: %s", robot, error)
            return
        self._take_report(robot, answer.report, answer.sign)
        if answer.blocked:
            self._take(ObstacleSeen(robot, answer.blocked))
        if answer.freed:
            self._take(ObstacleGone(robot, answer.freed))

    def _take_status(self, robot: str, message: Message) -> None:
        self._client_grids[robot] = grid_name(message.grid)
        self._take_report(robot, read_report(message), read_sign(message))

    def _take_obstacle(self, event: ObstacleSeen | ObstacleGone) -> None:
        """Handle cells that a robot reports, unless they may be of the grid before."""
        if time.monotonic() >= self._obstacles_from:
            self._take(event)

    def _take_report(self, robot: str, report: ClientReport, sign: RobotSign) -> None:
        """Handle a move client's report; what it heard of the robot comes first, because it is older."""
        if sign.pose is not None:
            self._take(PoseSeen(robot, *sign.pose))
        if sign.age is not None:
            self._take(RobotHeard(robot, sign.age))
        self._take(ReportSeen(robot, report))

    async def _keep_time(self) -> None:
        while await self._node.sleep(TICK):
            self._handle(Tick())
            self._state.update(time.monotonic())

    async def _make_plans(self, worker: PlanWorker) -> None:
        while True:
            planner, request = await self._requests.get()
            result = await worker.compute(request)
            if planner is self._planner:  # else the grid was changed meanwhile
                self._handle(PlanMade(result))

    def _set_goal(self, request: Message) -> dict[str, Any]:
        return self._ask(GoalSet(request.robot, None if request.cell < 0 else request.cell))

    def _block_cell(self, request: Message) -> dict[str, Any]:
        return self._ask(CellBlocked(request.cell) if request.blocked else CellFreed(request.cell))

    def _remove_robot(self, request: Message) -> dict[str, Any]:
        return self._ask(RobotRemoved(request.robot))

    async def _set_grid(self, request: Message) -> dict[str, Any]:
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
            if self._client_grids.get(robot, own) != own:
                return f"the move client of {robot} does not take its grid from {GRID_TOPIC}"
        return refuse_grid(self._planner, grid)

    async def _take_grid(self, grid: GridMap, choice: GridChoice) -> None:
        """Begin anew with another grid: first the grid is published, then the state and lists of it."""
        self._planner, instructions = next_planner(self._planner, grid, time.monotonic())
        self._obstacles_from = time.monotonic() + OLD_CELLS_LAST
        self._chooser.blocked_share = choice.blocked_share
        self._state.restart(self._planner)
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
        self._publish_requested(self._shown_blocked)
        return {"ok": reply.ok, "message": reply.message}

    def _take(self, event: Event) -> None:
        """Pass an event to the planner."""
        self._handle(event)

    def _handle(self, event: Event) -> list[Instruction]:
        """Pass an event to the planner and carry out its instructions."""
        instructions = self._planner.handle(event, time.monotonic())
        self._carry_out(instructions)
        return instructions

    def _carry_out(self, instructions: list[Instruction]) -> None:
        for instruction in instructions:
            match instruction:
                case SendCells(robot, revision, cells):
                    grid = "" if self._takes_answers else grid_name(self._state.started)
                    self._cells[robot].publish(numbered_array(cells, revision, grid))
                case SendCancel(robot):
                    self._cancels[robot].publish(data=True)
                case BlockedChanged(cells):
                    self._publish_blocked(cells)
                case MakePlan(request):
                    self._requests.put_nowait((self._planner, request))
                case Reply():
                    pass  # for the caller
                case _:
                    assert_never(instruction)

    def _publish_requested(self, blocked: tuple[int, ...]) -> None:
        """Publish the blocked cells that people asked for, if they changed."""
        requested = tuple(cell for cell in blocked if cell not in self._planner.state.sensed)
        if requested != self._shown_requested:
            self._shown_requested = requested
            self._requested.publish(data=list(requested))

    def _publish_blocked(self, cells: tuple[int, ...]) -> None:
        self._blocked.publish(data=list(cells))
        self._publish_requested(cells)
        fields = grid_fields(self._planner.state.grid, cells, self._node.now(), self._state.started)
        for grids in (self._map, self._old_map):
            if grids is not None:
                grids.publish(fields)
        self._shown_blocked = cells


async def main() -> None:
    """Run the planner until the node is stopped."""
    async with Node("fleet_planner") as node:
        values = await read_fleet_parameters(node)
        settings = FleetSettings(
            robot_radius=float(values.get("robot_radius", FleetSettings().robot_radius)),
            seed=int(values.get("seed", 0)),
        )
        takes_answers = bool(values.get("answers", False))
        chooser = GridChooser(values, make_grid(values))
        grid, remark = await chooser.grid_at_start(None if takes_answers else values.get(CHOSEN))
        if remark:
            node.log.warning("%s", remark)
        planner = PlannerNode(node, FleetPlanner(grid, settings), chooser, takes_answers=takes_answers)
        await planner.run(chooser.blocked_at_start(grid))


if __name__ == "__main__":
    run(main())
