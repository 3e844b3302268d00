"""Services of the simulated world: pause, step and reset it; spawn, move and remove robots, boxes and people.

They have Gazebo's names and types, so that programs written for it work; ``/simulation/...`` are the same
ones under the project's own names. ``model_xml`` of a request to spawn holds YAML, as in a scene:
``{robot: turtlebot2, sensor: lidar}``, ``{box: [0.6, 0.4]}`` or ``{walker: [[3.0, 4.5]]}``.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Awaitable, Callable
from math import isfinite
from typing import TYPE_CHECKING, Any, Protocol

import yaml
from pydantic import Field, ValidationError

from rce.config import ConfigError
from rce.config.validation import Strict, faults_of
from rce_fleet.drivers.fields import pose_fields, twist_fields
from rce_fleet.drivers.scene_items import Place, RobotStart, Size
from rce_fleet.exceptions import FleetError
from rce_fleet.geometry.angles import yaw_of
from rce_fleet.geometry.poses import Pose, Twist
from rce_fleet.simulation.box import BoxSpec, cell_of_box
from rce_fleet.simulation.walkers import WalkerSpec

if TYPE_CHECKING:
    from rce.ros.node import Node, Publisher
    from rce.ros.types import Message
    from rce_fleet.drivers.runner import WorldRunner

_log = logging.getLogger(__name__)

STATES_EVERY = 0.1
"""Seconds between two messages with the states of all things, if there are few."""
THINGS_TOPIC = "/simulation/things"
"""Latched JSON: ``paused``, and ``things`` by name: ``["robot"]``, ``["light"]`` (a light robot),
``["box", width, depth]`` or ``["walker", radius]``, metres."""
THINGS_PER_S = 1000
"""States that are published in a second, at most."""
WALKER_STOPS_M = 0.4
"""A person who was put in stops for a robot that is this near in front, metres between hulls."""
MAX_STEP = 60.0
"""Most seconds that one request may step."""
Answer = dict[str, Any]
_Handler = Callable[["Message"], Answer | Awaitable[Answer] | None]


class RobotKeeper(Protocol):
    """Adds and removes robots with their ROS graphs."""

    async def add_robot(self, start: RobotStart) -> str:
        """Put a robot into the world, and start its node; return the URI of its ROS master."""

    async def remove_robot(self, robot: str) -> None:
        """Stop a robot's node, and take the robot out of the world."""


class SpawnText(Strict):
    """What is spawned: a robot of a model, a box, or a person."""

    robot: str = ""
    sensor: str = ""
    override: dict[str, Any] = Field(default_factory=dict)
    box: Size | None = None
    glass: bool = False
    walker: tuple[Place, ...] | None = Field(default=None, strict=False)
    """Where the person walks to from the initial pose, again and again; empty: nowhere."""


class WorldServices:
    """Provides the services.

    Args:
        node: Running node in the world's graph.
        runner: Advances the world.
        robots: Adds and removes robots.
    """

    def __init__(self, node: Node, runner: WorldRunner, robots: RobotKeeper) -> None:
        self._node = node
        self._runner = runner
        self._robots = robots
        self._states: Publisher | None = None
        self._things: Publisher | None = None
        self._told = ""
        """What :data:`THINGS_TOPIC` said last."""
        self._boxes_told: frozenset[str] = frozenset()
        self._states_at, self._pause = 0.0, STATES_EVERY
        """When they were published last, and for how long."""

    async def start(self) -> None:
        """Provide the services until the node ends."""
        node = self._node
        self._states = await node.advertise("/gazebo/model_states", "gazebo_msgs/ModelStates")
        self._things = await node.advertise(THINGS_TOPIC, "std_msgs/String", latch=True)
        self._runner.on_update.append(self._publish_states)
        self._tell_things()
        for own, gazebo, service_type, handler in self._table():
            for name in (f"/simulation/{own}", *(f"/gazebo/{name}" for name in gazebo)):
                await node.advertise_service(name, service_type, self._telling(handler))
        for door in self._runner.world.doors:
            await node.advertise_service(f"/simulation/doors/{door}", "std_srvs/SetBool", self._opener(door))

    def _table(self) -> list[tuple[str, tuple[str, ...], str, _Handler]]:
        """Return own name, Gazebo's names, type and handler of each service."""
        empty = "std_srvs/Empty"
        return [
            ("pause", ("pause_physics",), empty, lambda _: self._runner.pause()),
            ("resume", ("unpause_physics",), empty, lambda _: self._runner.resume()),
            ("reset_world", ("reset_world",), empty, lambda _: self._runner.reset(time=False)),
            ("reset", ("reset_simulation",), empty, lambda _: self._runner.reset(time=True)),
            ("step", (), "fleet/StepWorld", self._step),
            ("spawn", ("spawn_sdf_model", "spawn_urdf_model"), "gazebo_msgs/SpawnModel", self._spawn),
            ("remove", ("delete_model",), "gazebo_msgs/DeleteModel", self._remove),
            ("move", ("set_model_state",), "gazebo_msgs/SetModelState", self._move),
            ("state", ("get_model_state",), "gazebo_msgs/GetModelState", self._state),
            ("world", ("get_world_properties",), "gazebo_msgs/GetWorldProperties", self._properties),
        ]

    def _telling(self, handler: _Handler) -> Callable[[Message], Awaitable[Answer | None]]:
        """Return a handler that also tells what changed, which a paused world does not do by itself."""

        async def handle(request: Message) -> Answer | None:
            answer = handler(request)
            reply = await answer if isinstance(answer, Awaitable) else answer
            self._tell_things()
            if self._runner.paused:
                self._publish_states(at_once=True)
            return reply

        return handle

    # Time

    def _step(self, request: Message) -> Answer:
        seconds = request.seconds
        if not self._runner.paused:
            return {"ok": False, "time": self._runner.time, "message": "pause the world first"}
        if not 0 <= seconds <= MAX_STEP:
            text = f"seconds must be within 0 .. {MAX_STEP:g}, not {seconds}"
            return {"ok": False, "time": self._runner.time, "message": text}
        self._runner.step(seconds)
        return {"ok": True, "time": self._runner.time, "message": ""}

    # Things

    async def _spawn(self, request: Message) -> Answer:
        name = request.model_name
        if name in self._names() or self._runner.world.has_box(name):
            return _refused(f"{name} exists already; choose another name")
        try:
            pose = _pose_of(request.initial_pose, request.reference_frame)
            wanted = _read_spawn(request.model_xml)
            more = ""
            if wanted.box is not None:
                if not name or cell_of_box(name) is not None:
                    return _refused(
                        f"a box cannot be named {name!r}: boxes in cells are; choose another name"
                    )
                self._runner.world.put_box(name, BoxSpec(pose, *wanted.box, wanted.glass))
            elif wanted.walker is not None:
                ways = ((pose.x, pose.y), *wanted.walker)
                self._runner.world.put_walker(name, WalkerSpec(ways, social_distance=WALKER_STOPS_M))
            else:
                start = RobotStart(
                    id=name,
                    at=(pose.x, pose.y),
                    yaw=pose.yaw,
                    model=wanted.robot,
                    sensor=wanted.sensor,
                    override=wanted.override,
                )
                uri = await self._robots.add_robot(start)
                more = f"; its ROS master is {uri}; it joins the fleet once rce-ros and its nodes run for it"
        except ValidationError as error:
            return _refused("; ".join(str(fault) for fault in faults_of(error, RobotStart)))
        except (FleetError, ConfigError, ValueError, OSError) as error:
            return _refused(str(error))
        return _done(f"{name} stands at ({pose.x:.2f}, {pose.y:.2f}){more}")

    async def _remove(self, request: Message) -> Answer:
        name = request.model_name
        if name in self._runner.world.robots:
            await self._robots.remove_robot(name)
        elif self._runner.world.has_box(name):
            self._runner.world.take_box(name)
        elif name in self._runner.world.walkers:
            self._runner.world.remove_walker(name)
        elif (light := self._runner.world.light) is not None and (row := light.row(name)) is not None:
            light.remove(row)
        else:
            return _refused(self._unknown(name))
        return _done(f"{name} was removed")

    def _move(self, request: Message) -> Answer:
        state, world, paused = request.model_state, self._runner.world, self._runner.paused
        try:
            pose = _pose_of(state.pose, state.reference_frame)
            twist = _twist_of(state.twist)
            if state.model_name in world.robots:
                world.move_robot(state.model_name, pose, as_start=paused)
                world.robots[state.model_name].drive(twist)
            elif world.light is not None and world.light.row(state.model_name) is not None:
                world.move_light_robot(state.model_name, pose, as_start=paused)
            elif state.model_name in world.all_boxes:
                world.move_box(state.model_name, pose)
            elif state.model_name in world.walkers:
                world.move_walker(state.model_name, pose.x, pose.y)
            else:
                return _refused(self._unknown(state.model_name))
        except (FleetError, ValueError) as error:
            return _refused(str(error))
        starts = paused and state.model_name not in (*world.all_boxes, *world.walkers)
        return _done(f"{state.model_name} {'starts there' if starts else 'was moved'}")

    def _state(self, request: Message) -> Answer:
        if request.relative_entity_name not in ("", "world", "map"):
            return _refused("only states in the frame 'world' are known; leave relative_entity_name empty")
        found = dict(self._all_states()).get(request.model_name)
        if found is None:
            return _refused(self._unknown(request.model_name))
        pose, twist = found
        header = {"stamp": self._runner.stamp(), "frame_id": "world"}
        return {"header": header, "pose": pose_fields(pose), "twist": twist_fields(twist), **_done("")}

    def _properties(self, _request: Message) -> Answer:
        return {"sim_time": self._runner.time, "model_names": self._names(), **_done("")}

    def _opener(self, door: str) -> _Handler:
        def move(request: Message) -> Answer:
            self._runner.world.doors[door].wanted = bool(request.data)
            return {"success": True, "message": f"{door} {'opens' if request.data else 'closes'}"}

        return move

    # What there is

    def _all_states(self) -> list[tuple[str, tuple[Pose, Twist]]]:
        world = self._runner.world
        found = [(name, (robot.pose, robot.twist)) for name, robot in world.robots.items()]
        if (light := world.light) is not None:
            present = light.present_names.items()
            found += [(name, (light.pose(row), light.twist(row))) for row, name in present]
        found += [(name, (box.pose, Twist())) for name, box in world.all_boxes.items()]
        found += [(name, (Pose(*each.position, 0.0), Twist())) for name, each in world.walkers.items()]
        return found

    def _names(self) -> list[str]:
        return [name for name, _ in self._all_states()] + list(self._runner.world.doors)

    def _unknown(self, name: str) -> str:
        return f"there is no {name!r}; known: {', '.join(self._names()) or 'nothing'}"

    def _tell_things(self) -> None:
        """Publish what there is, if that changed."""
        world, paused = self._runner.world, self._runner.paused
        things: dict[str, list[Any]] = {name: ["robot"] for name in world.robots}
        light = {} if world.light is None else world.light.present_names
        things |= {name: ["light"] for name in light.values()}
        things |= {name: ["box", box.width, box.depth] for name, box in world.all_boxes.items()}
        things |= {name: ["walker", walker.spec.radius] for name, walker in world.walkers.items()}
        text = json.dumps({"paused": paused, "things": things}, separators=(",", ":"))
        if text != self._told and self._things is not None:
            self._told = text
            self._things.publish(data=text)

    def _publish_states(self, *, at_once: bool = False) -> None:
        runner, states = self._runner, self._states
        is_due = at_once or abs(runner.time - self._states_at) >= self._pause
        if states is None or not states.connections or not is_due:
            return
        boxes = frozenset(runner.world.all_boxes)
        if boxes != self._boxes_told:  # those of cells and timed ones come without a request
            self._boxes_told = boxes
            self._tell_things()
        found = self._all_states()
        self._states_at, self._pause = runner.time, max(STATES_EVERY, len(found) / THINGS_PER_S)
        states.publish(
            name=[name for name, _ in found],
            pose=[pose_fields(pose) for _, (pose, _) in found],
            twist=[twist_fields(twist) for _, (_, twist) in found],
        )


def _read_spawn(text: str) -> SpawnText:
    """Read what is to be spawned.

    Raises:
        ValueError: The text is not what is expected.
    """
    expected = (
        "model_xml must be YAML such as {robot: turtlebot2, sensor: lidar}, {box: [0.6, 0.4]} or"
        " {walker: [[3.0, 4.5]]}"
    )
    if text.lstrip().startswith("<"):
        raise ValueError(f"{expected}, not XML")
    try:
        found = SpawnText.model_validate(yaml.safe_load(text))
    except yaml.YAMLError as error:
        raise ValueError(f"{expected}: {error}") from error
    except ValidationError as error:
        faults = "; ".join(str(fault) for fault in faults_of(error, SpawnText))
        raise ValueError(f"{expected}: {faults}") from error
    if [bool(found.robot), found.box is not None, found.walker is not None].count(True) != 1:
        raise ValueError(f"{expected}: it has to name either a robot's model, a box or a walker")
    return found


def _pose_of(pose: Message, frame: str) -> Pose:
    """Return a pose of a message.

    Raises:
        ValueError: It is in another frame, or not finite.
    """
    if frame not in ("", "world", "map"):
        raise ValueError(f"only poses in the frame 'world' are accepted, not in {frame!r}")
    x, y, turn = pose.position.x, pose.position.y, pose.orientation
    yaw = yaw_of(turn.x, turn.y, turn.z, turn.w)
    if not all(map(isfinite, (x, y, yaw))):
        raise ValueError(f"the pose must be finite numbers, not ({x}, {y}, {yaw})")
    return Pose(x, y, yaw)


def _twist_of(twist: Message) -> Twist:
    """Return the speeds of a message.

    Raises:
        ValueError: They are not finite.
    """
    speed, turn_rate = twist.linear.x, twist.angular.z
    if not (isfinite(speed) and isfinite(turn_rate)):
        raise ValueError(f"the speeds must be finite numbers, not {speed} and {turn_rate}")
    return Twist(speed, turn_rate)


def _done(text: str) -> Answer:
    return {"success": True, "status_message": text}


def _refused(text: str) -> Answer:
    _log.warning("simulation: a request was refused: %s", text)
    return {"success": False, "status_message": text}
