"""``slam_graph/slam_graph``: maps with one or several robots, localizes in saved maps.

Topics, services and parameters are those of ``gmapping/slam_gmapping``, and services to save and load. The
work is done by :mod:`rce_fleet.mapping.graph`, in a thread; this node passes messages to it and from it.
"""

from __future__ import annotations

import asyncio
from contextlib import AsyncExitStack
from typing import TYPE_CHECKING, Any

import numpy as np

from rce.ros.node import Message, Node, Publisher, Time, run
from rce.ros.tf import StampedTransform, Transform, TransformBroadcaster, TransformListener
from rce_fleet.compiled import compile_kernels
from rce_fleet.exceptions import FleetError, MapError
from rce_fleet.nodes.diagnostics import Diagnostics, Level
from rce_fleet.nodes.map_messages import map_fields
from rce_fleet.nodes.mapped_robot import MappedRobot
from rce_fleet.nodes.parameters import read_parameters
from rce_fleet.nodes.slam_graph_parameters import GMAPPING_ONLY, SlamGraphParameters
from rce_fleet.nodes.slam_graph_session import SlamGraphSession
from rce_fleet.nodes.throttled_log import ThrottledLog

if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import TypeVar

    from numpy.typing import NDArray

    from rce_fleet.mapping.records import LaserRecord
    from rce_fleet.maps.occupancy_map import OccupancyMap

    T = TypeVar("T")

WAITING_SCANS = 50
"""So many scans wait for the mapper; then the oldest one is dropped."""
REPORT_EVERY = 1.0
QUIET = 5.0
"""After this time without a scan the diagnostics warn, seconds."""


class SlamGraphNode:
    """The node.

    Args:
        node: Running node.
        parameters: Its parameters.

    Attributes:
        mapped: Number of mapped scans of each robot.
    """

    def __init__(self, node: Node, parameters: SlamGraphParameters) -> None:
        self._node = node
        self._parameters = parameters
        self._throttled_log = ThrottledLog(node)
        self._session = SlamGraphSession(parameters)
        self._turn = asyncio.Lock()
        self._scans: asyncio.Queue[tuple[str, LaserRecord]] = asyncio.Queue()
        self._robots: list[MappedRobot] = []
        self._odometry: dict[str, NDArray[np.float64]] = {}
        self._transforms: dict[str, NDArray[np.float64]] = {}
        self._map: OccupancyMap | None = None
        self.mapped: dict[str, int] = {}
        self._fault = ""
        self._undone = 0
        self._maps: Publisher
        self._metadata: Publisher
        self._diagnostics: Diagnostics

    async def run(self) -> None:
        """Map until the node is stopped."""
        node, parameters = self._node, self._parameters
        await asyncio.to_thread(compile_kernels)
        try:
            if parameters.load_map or parameters.localize_only:
                await asyncio.to_thread(self._session.load)
        except MapError as error:
            self._fault = str(error)
            node.log.error("the map cannot be loaded: %s", error)  # noqa: TRY400 - the user's file
            if parameters.localize_only:
                node.log.error("nothing to localize in: correct ~map_file and call ~load_map")  # noqa: TRY400 - as above
        self._maps = await node.advertise("map", "nav_msgs/OccupancyGrid", latch=True)
        self._metadata = await node.advertise("map_metadata", "nav_msgs/MapMetaData", latch=True)
        self._diagnostics = await Diagnostics.start(node, "mapping")
        await node.advertise_service("dynamic_map", "nav_msgs/GetMap", self._get_map)
        await node.advertise_service("~save_map", "std_srvs/Trigger", self._save)
        await node.advertise_service("~load_map", "std_srvs/Trigger", self._load)
        async with AsyncExitStack() as stack:
            listener = await stack.enter_async_context(TransformListener(node, prefix=""))
            broadcaster = await stack.enter_async_context(TransformBroadcaster(node, prefix=listener.prefix))
            tasks = await stack.enter_async_context(asyncio.TaskGroup())
            for name in parameters.robots or ("",):
                robot = MappedRobot(node, name, parameters, listener, self._throttled_log, self._take)
                self._robots.append(robot)
                await robot.start()
            work = [
                tasks.create_task(self._map_scans()),
                tasks.create_task(self._publish_maps()),
                tasks.create_task(self._publish_transforms(broadcaster)),
            ]
            while await node.sleep(REPORT_EVERY):
                self._report()
            for task in work:
                task.cancel()

    async def _in_thread(self, function: Callable[..., T], *arguments: Any) -> T:
        """Run a method of the session when its turn comes; the loop goes on meanwhile."""
        async with self._turn:
            return await asyncio.to_thread(function, *arguments)

    # Scans

    def _take(self, robot: str, record: LaserRecord) -> None:
        if self._scans.qsize() >= WAITING_SCANS:
            self._scans.get_nowait()
            self._throttled_log.warn(
                "slow", "scans come faster than they can be mapped: some are left out; raise ~throttle_scans"
            )
        self._scans.put_nowait((robot, record))

    async def _map_scans(self) -> None:
        while True:
            robot, record = await self._scans.get()
            try:
                transform = await self._in_thread(self._session.add, robot, record)
            except (FleetError, ValueError) as error:
                self._throttled_log.warn("scan", f"a scan cannot be mapped: {error}")
                continue
            self.mapped[robot] = self.mapped.get(robot, 0) + 1
            self._warn_of(robot)
            self._odometry[robot] = np.array(record.odometry)
            if transform is None:
                self._transforms.pop(robot, None)
            else:
                self._transforms[robot] = transform
            for other, odometry in self._odometry.items():
                moved = self._session.map_from_odom(other, odometry)
                if moved is not None:
                    self._transforms[other] = moved
                elif other != robot and not self._parameters.localize_only:
                    self._transforms.pop(other, None)

    def _warn_of(self, robot: str) -> None:
        """Say what the last scan of a robot has shown to be wrong."""
        jump = self._session.jump(robot)
        if jump:
            prefix = f"{robot}: " if robot else ""
            text = f"{prefix}{jump}; the scans tell how the robot moved"
            self._throttled_log.warn(f"{robot} jump", text)
        if self._session.undone > self._undone:
            self._node.log.warning(
                "robots were joined at the wrong place: scans of %s contradict it. They are apart until "
                "scans match again",
                robot or "the robot",
            )
        self._undone = self._session.undone

    # Results

    async def _publish_transforms(self, broadcaster: TransformBroadcaster) -> None:
        parameters = self._parameters
        period = parameters.transform_publish_period
        delay = period if parameters.tf_delay is None else parameters.tf_delay
        while period > 0 and await self._node.sleep(period):
            stamp = Time.from_sec(self._node.time() + delay)
            sent = [
                StampedTransform(
                    parameters.map_frame,
                    robot.odom_frame,
                    Transform.make(pose[0], pose[1], yaw=pose[2]),
                    stamp,
                )
                for robot in self._robots
                if (pose := self._transforms.get(robot.name)) is not None
            ]
            if sent:
                broadcaster.send_stamped(*sent)

    async def _publish_maps(self) -> None:
        published: OccupancyMap | None = None
        while True:
            await self._draw()
            if self._map is not None and self._map is not published:
                published = self._map
                fields = self._map_fields(published)
                self._maps.publish(**fields)
                self._metadata.publish(**fields["info"])
            # The first map comes at once, as gmapping's does.
            pause = 0.2 if published is None else self._parameters.map_update_interval
            if not await self._node.sleep(pause):
                return

    async def _draw(self) -> None:
        try:
            self._map = await self._in_thread(self._session.occupancy_map)
        except MapError as error:
            self._fault = f"the map cannot be drawn: {error}"
            self._throttled_log.warn("draw", self._fault)

    def _map_fields(self, drawn: OccupancyMap) -> dict[str, Any]:
        return map_fields(drawn, self._parameters.map_frame, self._node.now())

    async def _get_map(self, _request: Message) -> dict[str, Any]:
        await self._draw()
        return {} if self._map is None else {"map": self._map_fields(self._map)}

    async def _save(self, _request: Message) -> dict[str, Any]:
        return await self._do(self._session.save)

    async def _load(self, _request: Message) -> dict[str, Any]:
        answer = await self._do(self._session.load)
        if answer["success"]:
            self._transforms.clear()
            self._odometry.clear()
        return answer

    async def _do(self, function: Callable[[], str]) -> dict[str, Any]:
        try:
            text = await self._in_thread(function)
        except MapError as error:
            self._node.log.error("%s", error)  # noqa: TRY400 - the user's file
            return {"success": False, "message": str(error)}
        self._fault = ""
        self._node.log.info("%s", text)
        return {"success": True, "message": text}

    def _report(self) -> None:
        now = self._node.time()
        faults = [self._fault] if self._fault else []
        for robot in self._robots:
            name = robot.name or "the robot"
            if robot.fault:
                faults.append(robot.fault)
            elif robot.stamp is None:
                faults.append(f"no scan of {name} yet")
            elif now - robot.stamp.to_sec() > QUIET:
                faults.append(f"no scan of {name} for {now - robot.stamp.to_sec():.0f} s")
            elif robot.name not in self._transforms:
                faults.append(f"the place of {name} on the map is not known yet")
        values = {
            "keyscans": str(len(self._session.graph)),
            "loops": str(self._session.loops),
            "waiting scans": str(self._scans.qsize()),
        }
        level = Level.ERROR if self._fault else Level.WARN if faults else Level.OK
        self._diagnostics.publish(level, "; ".join(faults) or "mapping", values)


async def main() -> None:
    """Run the node until it is stopped."""
    async with Node("slam_graph") as node:
        await SlamGraphNode(
            node, await read_parameters(node, SlamGraphParameters, unused=GMAPPING_ONLY)
        ).run()


if __name__ == "__main__":
    run(main())
