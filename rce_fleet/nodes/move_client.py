"""Sends a robot along its granted cells, goal by goal. Runs in the robot's namespace.

The work is done by :mod:`rce_fleet.coordination.move_client`; this node passes messages to it and from it.
``share/README.md`` lists the topics.
"""

from __future__ import annotations

import time
from math import inf
from typing import TYPE_CHECKING, Any, assert_never

from rce.ros.node import MasterError, Message, Node, Publisher, Time, run
from rce.ros.node.master import MasterClient
from rce.ros.xmlrpc import RpcClient
from rce_fleet.coordination.answers import (
    Answer,
    answer_array,
    grid_of,
    is_answer,
    planner_of,
    revision_of,
    speed_of,
)
from rce_fleet.coordination.move_client import (
    ClientReport,
    ClientState,
    GoalState,
    Instruction,
    MoveClient,
    SendGoal,
    SendStop,
)
from rce_fleet.coordination.robot_signs import RobotSigns
from rce_fleet.exceptions import MapError
from rce_fleet.geometry.angles import quaternion_z, yaw_of
from rce_fleet.nodes.grid_messages import (
    GRID_TOPIC,
    LEAST_CELL,
    MAP_FRAME,
    OLD_TOPIC,
    grid_name,
    read_grid,
)
from rce_fleet.nodes.grid_parameters import GRID_PARAMETERS, make_grid, unknown_parameters
from rce_fleet.nodes.throttled_log import ThrottledLog
from rce_fleet.planning.grid import GridMap

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rce_fleet.nodes.namespaced import NamespacedNode

TICK = 0.25
"""Seconds between two timer events."""
REPORT_EVERY = 0.5
"""Seconds after which the progress is published again."""
QUIET_AFTER, REPORT_QUIET_EVERY = 5.0, 1.0
"""Seconds without any progress after which it is published more seldom, and how often."""
_PARAMETERS = GRID_PARAMETERS | {"alive_topic", "answers"}
OLD_MAP_AFTER = 5.0
"""Seconds without the grid after which a move client looks for it on its old topic."""


class MoveClientNode:
    """A move client in a ROS graph.

    Args:
        node: Running node, in the robot's namespace.
        hears_grid: Whether it takes the grid from its topic; else it is given by :meth:`take_grid`.
    """

    def __init__(self, node: Node | NamespacedNode, *, hears_grid: bool = True) -> None:
        self._node = node
        self._hears_grid = hears_grid
        self._client: MoveClient | None = None
        self._reported_at = 0.0
        self._progressed_at = 0.0
        self._reported: ClientReport | None = None
        self._goals: Publisher
        self._stops: Publisher
        self._reports: Publisher
        self._speeds: Publisher
        self._speed: float | None = None
        """What the robot was told last; it may have an old limit from a move client before this one."""
        self._answers = False
        self._hears_old = False
        self._grid = Time()
        self._planner = ""
        """The planner that sent the newest list."""
        self._signs = RobotSigns()
        self._throttled_log = ThrottledLog(node)
        self._alive_topic = ""

    def _read_grid(self, values: Mapping[str, Any]) -> GridMap | None:
        """Return the grid that the parameters describe; None if they describe none."""
        if self._hears_grid:
            for remark in unknown_parameters(values, _PARAMETERS):
                self._node.log.warning("%s", remark)
        if not values.keys() & {"rows", "map", "map_yaml"}:
            return None
        try:
            return make_grid(values)
        except (ValueError, MapError, OSError) as error:
            text = "the grid on %s is waited for instead: %s"
            self._node.log.error(text, GRID_TOPIC, error)  # noqa: TRY400 - a user's mistake
            return None

    async def run(self) -> None:
        """Send the robot along until the node is stopped."""
        await self.start()
        await self.keep_time()

    async def start(self) -> None:
        """Create publishers and subscribers. They end with the node."""
        node = self._node
        self._goals = await node.advertise("move_base/goal", "move_base_msgs/MoveBaseActionGoal")
        self._speeds = await node.advertise("speed_limit", "std_msgs/Float64", latch=True)
        self._stops = await node.advertise("move_base/cancel", "actionlib_msgs/GoalID")
        values = await node.get_param("~", {})
        self._answers = bool(values.get("answers", False))
        grid = self._read_grid(values)
        if grid is not None:
            self.take_grid(grid)
        elif self._hears_grid:
            await node.subscribe(GRID_TOPIC, "nav_msgs/OccupancyGrid", self._take_map)
        if self._answers:
            self._reports = await node.advertise("goalNodesList", "std_msgs/Int32MultiArray")
            await node.subscribe("blockedCells", "std_msgs/Int32MultiArray", self._take_blocked)
            await node.subscribe("freedCells", "std_msgs/Int32MultiArray", self._take_freed)
        else:
            self._reports = await node.advertise("moveClient/status", "fleet/MoveStatus")
        await node.subscribe("goalNodesList", "std_msgs/Int32MultiArray", self._take_cells)
        await node.subscribe("cancelGoal", "std_msgs/Bool", self._take_cancel)
        await node.subscribe("move_base/status", "actionlib_msgs/GoalStatusArray", self._take_states)
        await node.subscribe("move_base/result", "move_base_msgs/MoveBaseActionResult", self._take_result)
        await node.subscribe(
            "move_base/feedback", "move_base_msgs/MoveBaseActionFeedback", self._take_feedback
        )
        self._alive_topic = str(values.get("alive_topic", ""))
        if self._alive_topic:
            await node.subscribe_serialized(self._alive_topic, "*", lambda _payload, _latched: self._hear())

    async def keep_time(self) -> None:
        """Tick until the node is stopped; look for the grid's old topic while the grid is missing."""
        node = self._node
        look_at = time.monotonic() + OLD_MAP_AFTER
        while await node.sleep(TICK):
            self.tick()
            is_blind = self._client is None and self._hears_grid and not self._hears_old
            if is_blind and time.monotonic() >= look_at:
                await self._look_for_old_map()
                look_at = time.monotonic() + OLD_MAP_AFTER

    def tick(self) -> None:
        """Send again what had no effect, and a report if one is due; call it every ``TICK`` seconds."""
        if self._client is None:
            return
        now = self._node.time()
        self._do(self._client.tick(now))
        is_quiet = now - self._progressed_at >= QUIET_AFTER
        every = REPORT_QUIET_EVERY if is_quiet else REPORT_EVERY
        if not 0 <= now - self._reported_at < every:  # simulated time may jump back
            self._do([self._client.report])

    # What comes in

    def _take_map(self, message: Message) -> None:
        try:
            self.take_grid(read_grid(message), message.info.map_load_time)
        except ValueError as error:
            self._node.log.warning("the grid on %s cannot be used: %s", GRID_TOPIC, error)

    def _take_old_map(self, message: Message) -> None:
        """Take the grid from a planner or a robot file of before, if it is one."""
        if message.info.resolution >= LEAST_CELL:
            self._take_map(message)

    async def _look_for_old_map(self) -> None:
        """Listen to the grid's old topic, if only that one is published here."""
        try:
            async with RpcClient() as rpc:
                master = MasterClient(self._node.master_uri, self._node.name, self._node.uri, rpc)
                topics = {topic for topic, _ in await master.call("getPublishedTopics", "")}
        except MasterError as error:
            self._node.log.warning("cannot look for the grid: %s", error)
            return
        if OLD_TOPIC in topics and GRID_TOPIC not in topics:
            self._node.log.warning(
                "no %s here, only %s: connect %s in the robot's file", GRID_TOPIC, OLD_TOPIC, GRID_TOPIC
            )
            self._hears_old = True
            await self._node.subscribe(OLD_TOPIC, "nav_msgs/OccupancyGrid", self._take_old_map)

    def take_grid(self, grid: GridMap, made: Time | None = None) -> None:
        """Drive on a grid; a goal on another one before is cancelled."""
        self._grid = made or Time()
        revision, newest = 0, float("-inf")
        if self._client is not None:
            if grid == self._client.grid:
                return
            revision, newest = self._client.report.revision, self._client.newest_stamp
            self._node.log.info("new grid of %d x %d cells", grid.columns, grid.rows)
        now = self._node.time()
        self._client = MoveClient(grid, self._node.namespace.strip("/"), now, ClientReport(revision), newest)
        self._do(self._client.tick(now))

    def _take_blocked(self, message: Message) -> None:
        if self._client is not None:
            self._report(self._client.report, blocked=tuple(message.data))

    def _take_freed(self, message: Message) -> None:
        if self._client is not None:
            self._report(self._client.report, freed=tuple(message.data))

    def _take_cells(self, message: Message) -> None:
        labels = [dimension.label for dimension in message.layout.dim]
        if self._client is None or is_answer(labels):
            return
        wanted, own = grid_of(labels), grid_name(self._grid)
        if wanted and own and wanted != own:
            self._node.log.debug("cells of another grid are ignored; they are sent again")
            return
        revision = revision_of(labels)
        if revision is not None and revision > self._client.report.revision:
            self._planner = planner_of(labels)
        self._limit_speed(speed_of(labels))
        try:
            self._do(self._client.take_cells(revision, list(message.data), self._node.time()))
        except ValueError as error:
            self._throttled_log.warn("list", f"the list of cells was refused: {error}")

    def _limit_speed(self, speed: float) -> None:
        """Tell the robot the greatest speed in its cells; 0 m/s means that it is not limited any more."""
        if speed != self._speed or speed < inf:
            self._speed = speed
            self._speeds.publish(data=0.0 if speed == inf else speed)

    def _take_cancel(self, message: Message) -> None:
        if self._client is not None and message.data:
            self._do(self._client.cancel(self._node.time()))

    def _hear(self) -> None:
        self._signs.hear(time.monotonic())

    def _take_states(self, message: Message) -> None:
        if not self._alive_topic:
            self._hear()
        if self._client is not None:
            states = {entry.goal_id.id: GoalState(entry.status) for entry in message.status_list}
            stamps = (entry.goal_id.stamp.to_sec() for entry in message.status_list)
            if self._client.report.state is ClientState.CANCELLING:
                self._warn_of_others(self._client, states)
            newest = max(stamps, default=float("-inf"))
            self._do(self._client.take_goal_states(states, self._node.time(), newest))

    def _warn_of_others(self, client: MoveClient, states: dict[str, GoalState]) -> None:
        """Tell people why their goal ends, who sent it past the planner."""
        for goal, state in states.items():
            if not state.over and not goal.startswith(f"{client.name}-"):
                self._throttled_log.warn(
                    "goal",
                    f"the goal {goal!r} is cancelled: robots of a fleet enter only cells that the planner"
                    " granted; set goals on the fleet's page",
                )

    def _take_result(self, message: Message) -> None:
        if self._client is not None:
            status = message.status
            self._do(self._client.take_result(status.goal_id.id, GoalState(status.status), self._node.time()))

    def _take_feedback(self, message: Message) -> None:
        """Note where the robot is; planners need it where localization is silent."""
        place = message.feedback.base_position
        if place.header.frame_id.lstrip("/") != MAP_FRAME:
            return  # a move_base that plans in another frame: its poses are not of the map
        position, turn = place.pose.position, place.pose.orientation
        yaw = yaw_of(turn.x, turn.y, turn.z, turn.w)
        self._signs.take_pose(position.x, position.y, yaw, time.monotonic())

    # What goes out

    def _do(self, instructions: list[Instruction]) -> None:
        for instruction in instructions:
            match instruction:
                case SendGoal():
                    self._send_goal(instruction)
                case SendStop(stamp):
                    self._stops.publish(stamp=Time.from_sec(stamp), id="")
                case ClientReport():
                    self._report(instruction)
                case _:
                    assert_never(instruction)

    def _send_goal(self, goal: SendGoal) -> None:
        assert self._client is not None
        x, y = self._client.grid.centre(goal.cell)
        z, w = quaternion_z(goal.heading)
        stamp = Time.from_sec(goal.stamp)
        header = {"stamp": self._node.now(), "frame_id": MAP_FRAME}
        self._goals.publish(
            header=header,
            goal_id={"stamp": stamp, "id": goal.id},
            goal={
                "target_pose": {
                    "header": header,
                    "pose": {"position": {"x": x, "y": y}, "orientation": {"z": z, "w": w}},
                },
            },
        )

    def _report(
        self, report: ClientReport, blocked: tuple[int, ...] = (), freed: tuple[int, ...] = ()
    ) -> None:
        self._reported_at = self._node.time()
        if report != self._reported or self._reported_at < self._progressed_at:
            self._reported, self._progressed_at = report, self._reported_at
        sign = self._signs.sign(time.monotonic(), is_driving=report.state is ClientState.DRIVING)
        if self._answers:
            self._reports.publish(answer_array(Answer(report, blocked, freed, sign, self._planner)))
            return
        self._reports.publish(
            revision=report.revision,
            state=report.state.value,
            cells=list(report.cells),
            reached=-1 if report.reached is None else report.reached,
            target=-1 if report.target is None else report.target,
            robot_age=-1.0 if sign.age is None else sign.age,
            pose=[] if sign.pose is None else list(sign.pose),
            grid=self._grid,
        )


async def main() -> None:
    """Run the node until it is stopped."""
    async with Node("move_client") as node:
        await MoveClientNode(node).run()


if __name__ == "__main__":
    run(main())
