"""Measure the master's state at a large size: ``python -m benchmarks.scale [--quick]``. It needs no engine.

Machines are simulated: their task sets are commands to the state, and no process or socket is used. Each has
100 containers with a node and an interface each. ``create`` are further containers, ``full`` such that no
machine takes. ``lost`` is a machine that stayed away, from the tick that gives up its containers until all of
them have another machine, in slices of one command each; ``rack`` are 40 at once.

``holds`` is how long a command holds the master's event loop that concerns all robots of a large user, with
interfaces and connections in use, or a full queue when all machines come back, and each of its slices;
without the collections of garbage that fall into one of them by chance.

Times are those of the processor that the thread used, so that other load does not count.
"""

from __future__ import annotations

import argparse
import contextlib
import gc
import tracemalloc
from time import thread_time
from typing import Any

from benchmarks.figures import Results, percentile, show
from benchmarks.targets import beside_targets
from rce.control import (
    CONTROL_VERSION,
    EndpointState,
    EndpointStatus,
    Hello,
    MachineInfo,
    TaskSetKind,
)
from rce.model import InterfaceSpec, NodeSpec, Resources
from rce_master.exceptions import NoRoomError
from rce_master.state import commands, task_sets
from rce_master.state.changes import Changes
from rce_master.state.core import State, without_collections
from rce_master.state.user_records import User, UserRole

SIZES = (10, 100, 1000)
PER_MACHINE = 100
SLOTS = 150
CREATED = 200
RACK = 40
ROBOTS = 2000
IN_USE = 6
"""Interfaces and connections of each robot."""
PER_RETURNING = 50
"""Containers that wait, for each machine."""
MEGABYTE = 1e6


class Cloud:
    """A state with simulated machines and users, one user for each machine."""

    def __init__(self, machines: int, *, is_away: bool = False) -> None:
        self.machines = machines
        self.state = State()
        self.now = 1000.0
        self.rows: dict[str, dict[str, bytes]] = {}
        for number in range(machines):
            user = User(name=f"user{number}", role=UserRole.ADMIN, password="", created=0.0)
            self.do(commands.AddUser(user=user))
            if not is_away:
                self.arrive(number)

    def do(self, command: commands.Command) -> Changes:
        """Apply a command and keep its rows."""
        changes = self.state.apply(command, self.now)
        for row in changes.rows():
            if row.body is None:
                self.rows[row.table].pop(row.key, None)
            else:
                self.rows.setdefault(row.table, {})[row.key] = row.body
        return changes

    def arrive(self, number: int, endpoints: tuple[EndpointStatus, ...] = ()) -> Changes:
        """Let a machine connect."""
        hello = Hello(
            version=CONTROL_VERSION,
            kind=TaskSetKind.CONTAINER,
            process=f"c{number}",
            machine=MachineInfo(name=f"m{number}", cores=64, memory=2**38, slots=SLOTS),
            endpoints=endpoints,
        )
        return self.do(commands.TaskSetArrived(hello=hello))

    def connect_robots(self, count: int, parts: int) -> None:
        """Let robots of the first user connect, all at one task set."""
        self.do(commands.TaskSetArrived(hello=_robots()))
        for number in range(count):
            tag = f"r{number}"
            self.do(commands.RobotLogin(process="r", id=f"user0/{tag}"))
            for part in range(parts):
                spec = InterfaceSpec(
                    tag=f"i{part}", type="PublisherConverter", message_type="std_msgs/String"
                )
                self.do(commands.AddInterface(user="user0", endpoint=tag, interface=spec))
            self.do(commands.StatusReported(process="r", status=_in_use(number, parts)))

    def create(self, number: int) -> None:
        """Create a container with a node and an interface; users take turns."""
        user, tag = f"user{number % self.machines}", f"c{number}"
        self.do(commands.CreateContainer(user=user, tag=tag, resources=Resources()))
        self.do(commands.AddNode(user=user, container=tag, node=NodeSpec(tag="n", pkg="p", exe="e")))
        spec = InterfaceSpec(tag="i", type="PublisherInterface", message_type="std_msgs/String", addr="/x")
        self.do(commands.AddInterface(user=user, endpoint=tag, interface=spec))

    def time(self, *done: commands.Command) -> list[float]:
        """Apply commands and what they leave over; return the seconds of each slice."""
        times = []
        for command in done:
            began = thread_time()
            changes = self.state.apply(command, self.now)
            times += [thread_time() - began, *self.finish(changes)]
        return times

    def finish(self, changes: Changes) -> list[float]:
        """Continue what a command left over; return the seconds of each slice."""
        times = []
        while changes.unfinished:
            began = thread_time()
            changes = self.state.apply(commands.Continue(), self.now)
            times.append(thread_time() - began)
        return times


def measure(machines: int) -> dict[str, dict[str, Any]]:
    """Fill a state of this size; return a row of each suite."""
    cloud = Cloud(machines)
    began = thread_time()
    for number in range(machines * PER_MACHINE):
        cloud.create(number)
    filled = thread_time() - began
    gc.collect()
    gc.freeze()
    count = machines * PER_MACHINE
    created = [_timed(cloud, f"more{number}") for number in range(CREATED)]
    refused = [_timed(cloud, f"full{number}", size=SLOTS) for number in range(CREATED)]
    idle = [_tick(cloud) for _ in range(20)]
    lost = lose(cloud, 1)
    rack = lose(cloud, RACK) if machines > 10 * RACK else []  # the others have room for all then
    size = {"machines": machines, "containers": count}
    placing = {
        "filled, s": round(filled, 1),
        "create p50, ms": round(1e3 * percentile(created, 0.5), 3),
        "create p99, ms": round(1e3 * percentile(created, 0.99), 3),
        "full p50, ms": round(1e3 * percentile(refused, 0.5), 3),
        "tick, ms": round(1e3 * percentile(idle, 0.5), 3),
        "lost, ms": round(1e3 * sum(lost), 1),
        "longest slice, ms": round(1e3 * max(lost), 1),
        "slices": len(lost),
        "rack, s": round(sum(rack), 2) if rack else "",
        "its longest, ms": round(1e3 * max(rack), 1) if rack else "",
    }
    return {"placing": size | placing, "store": size | _load(cloud)}


def hold(robots: int, machines: int) -> list[dict[str, Any]]:
    """Return how long commands hold the event loop that concern many robots, or a full queue."""
    lost = commands.TaskSetLeft(process="r")
    changed = commands.SetPassword(name="user0", password="new")
    rows = []
    for parts in (0, IN_USE):
        back = task_sets.arrival(_robots(tuple(_in_use(number, parts) for number in range(robots))))
        cloud = Cloud(1)
        cloud.connect_robots(robots, parts)
        for what, done in (
            ("robot task set lost", [lost]),
            ("robot task set back", back),
            ("password changed", [changed]),
        ):
            with without_collections():
                times = cloud.time(*done)
            rows.append(_held(f"{what}, {robots} robots, {parts} interfaces each", times))
    rows.append(_held(f"full queue, {machines} machines return", _return(machines)))
    return rows


def _robots(there: tuple[EndpointStatus, ...] = ()) -> Hello:
    return Hello(
        version=CONTROL_VERSION,
        kind=TaskSetKind.ROBOT,
        process="r",
        machine=MachineInfo(name="r"),
        endpoints=there,
    )


def _in_use(number: int, parts: int) -> EndpointStatus:
    return EndpointStatus(
        id=f"user0/r{number}",
        revision=1,
        state=EndpointState.RUNNING,
        interfaces={f"i{part}": True for part in range(parts)},
        connections=tuple(range(number * parts, (number + 1) * parts)),
    )


def _held(what: str, times: list[float]) -> dict[str, Any]:
    return {
        "what": what,
        "slices": len(times),
        "sum, ms": round(1e3 * sum(times), 1),
        "longest, ms": round(1e3 * max(times), 1),
    }


def _return(machines: int) -> list[float]:
    """Let all machines but a full one come back at once; return the seconds of each command."""
    cloud = Cloud(machines, is_away=True)
    cloud.arrive(0)
    for number in range(SLOTS + machines * PER_RETURNING):
        command = commands.CreateContainer(user=f"user{number % machines}", tag=f"c{number}", wait=True)
        cloud.do(command)
    times = []
    with without_collections():
        for number in range(1, machines):
            began = thread_time()
            changes = cloud.arrive(number)
            times.append(thread_time() - began)
        times += cloud.finish(changes)
    assert not cloud.state.tables.endpoints.by("task_set", "")
    return times


def _timed(cloud: Cloud, tag: str, size: int = 1) -> float:
    command = commands.CreateContainer(user="user0", tag=tag, resources=Resources(size=size))
    began = thread_time()
    with contextlib.suppress(NoRoomError):
        cloud.do(command)
    return thread_time() - began


def _tick(cloud: Cloud) -> float:
    cloud.now += 0.5
    began = thread_time()
    cloud.state.apply(commands.Tick(), cloud.now)
    return thread_time() - began


def lose(cloud: Cloud, count: int) -> list[float]:
    """Let machines stay away; return the seconds of each command until all containers are placed again."""
    machines = [s.process for s in cloud.state.tables.task_sets][:count]
    for process in machines:
        cloud.do(commands.TaskSetLeft(process=process))
    cloud.now += cloud.state.settings.container_grace
    began = thread_time()
    changes = cloud.state.apply(commands.Tick(), cloud.now)
    times = [thread_time() - began, *cloud.finish(changes)]
    assert not cloud.state.tables.endpoints.by("task_set", "")
    assert not any(process in cloud.state.tables.task_sets for process in machines)
    return times


def _load(cloud: Cloud) -> dict[str, Any]:
    stored = sum(len(key) + len(body) for rows in cloud.rows.values() for key, body in rows.items())
    rows = cloud.rows
    cloud.state = State()
    gc.collect()
    began = thread_time()
    State.load(rows, 0.0)
    seconds = thread_time() - began
    gc.collect()
    tracemalloc.start()
    state = State.load(rows, 0.0)
    state.tables.rooms.get("c0")
    taken, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    return {
        "stored, MB": round(stored / MEGABYTE, 1),
        "load, s": round(seconds, 2),
        "tables, MB": round(taken / MEGABYTE, 1),
    }


def main() -> None:
    """Read the command line and measure."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.scale", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="10 and 100 machines only")
    options = parser.parse_args()
    results = Results("scale", quick=options.quick)
    measured = [measure(machines) for machines in (SIZES[:2] if options.quick else SIZES)]
    suites = {name: [rows[name] for rows in measured] for name in ("placing", "store")}
    suites["holds"] = hold(ROBOTS // 10, SIZES[1]) if options.quick else hold(ROBOTS, SIZES[-1])
    for name, rows in suites.items():
        results.keep(name, rows)
    show("Placing, processor time", suites["placing"])
    show("The store, and the state that is loaded from it", suites["store"])
    show("How long a command holds the event loop, processor time", suites["holds"])
    if not options.quick:
        show("Beside the targets", list(beside_targets("scale", suites)))
    print("results:", results.save())


if __name__ == "__main__":
    main()
