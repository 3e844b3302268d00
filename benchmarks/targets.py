"""The targets of the engine, and the rows of the suites that show whether they are reached."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from benchmarks import attacks, failover
from benchmarks.ros import tools
from benchmarks.target import Rows, Target, read_greatest, read_last, read_least

RATIOS = {
    "converter": {20: 2.9, 784: 2.7, 6951: 3.0, 61584: 3.0, 545559: 3.0, 4832930: 3.5, 10000000: 3.0},
    "forwarder": {20: 2.5, 784: 2.5, 6951: 2.5, 61584: 3.0, 545559: 2.5, 4832930: 2.5, 10000000: 2.0},
}
"""Round trip in times of a bare echo's in the same run, by bytes: half of rosbridge's time or less."""
RATIOS["forwarder, one frame"] = RATIOS["forwarder"]


_WAREHOUSE, _RANDOM = "warehouse-10-20-10-2-1", "random-32-32-20"
_PLANS = [
    *(
        Target(
            f"first plan for {robots} robots on {name}, least of 9 seeds",
            "planning.first",
            read_last("ms", map=name, robots=robots),
            limit,
            "ms",
        )
        for name, robots, limit in ((_WAREHOUSE, 1000, 150), (_WAREHOUSE, 400, 50), (_RANDOM, 400, 25))
    ),
    Target(
        f"first plan for 1000 robots on {_WAREHOUSE}, cost over lower bound, worst of 9 seeds",
        "planning.first",
        read_last("cost / bound, worst", map=_WAREHOUSE, robots=1000),
        3.3,
        "x bound",
    ),
    *(
        Target(
            f"plan for {robots} robots on {name} after 10 s, cost over lower bound",
            "planning.anytime",
            read_last("cost / bound", map=name, robots=robots, seconds=10.0),
            limit,
            "x bound",
        )
        for name, robots, limit in ((_WAREHOUSE, 400, 1.08), (_WAREHOUSE, 1000, 1.9), (_RANDOM, 400, 2.26))
    ),
    *(
        Target(
            f"lifelong, {robots} robots on aisles-33-46, tasks by robots over distance, worst seed",
            "planning.lifelong",
            read_least("share of robots / distance", robots=robots),
            limit,
            "share",
            at_least=True,
        )
        for robots, limit in ((100, 0.88), (140, 0.80))
    ),
    *(
        Target(
            f"lifelong, {robots} robots on aisles-33-46, longest step",
            "planning.lifelong",
            read_greatest("longest step ms", robots=robots),
            100,
            "ms",
        )
        for robots in (100, 140)
    ),
    *(
        Target(
            f"first plan for 10 000 robots on 3 x 3 {_WAREHOUSE}, {what}",
            "planning.large",
            read_last(column, robots=10_000),
            limit,
            unit,
        )
        for what, column, limit, unit in (("time", "s", 15, "s"), ("memory", "peak GB", 4, "GB"))
    ),
]
_ROUND_TRIPS = [
    Target(
        f"{path}, {size} bytes, p50",
        "roundtrip",
        read_last("x bare", path=path, bytes=size),
        limit,
        "x bare echo",
    )
    for path, limits in RATIOS.items()
    for size, limit in limits.items()
]

TLS_RATIO = {20: 1.15}
"""Most that TLS on the robot's connection may make of a round trip's median, by bytes."""

_IN_TLS = [
    Target(
        f"TLS on the robot's connection, {form}, {size} bytes, p50",
        "tls",
        read_last("x plain (p50)", form=form, bytes=size),
        limit,
        "x plain",
    )
    for form in ("Converter", "Forwarder")
    for size, limit in TLS_RATIO.items()
]

_LOCALIZATION = [
    Target(
        f"amcl in the demo's world, {sensor}: {what}",
        f"localization.{suite}",
        read_last(column, sensor=sensor),
        limit or near,
        unit,
        lower=lower,
    )
    for suite, sensor, near in (("lidar", "lidar", 0.05), ("camera", "depth camera", 0.10))
    for what, column, limit, unit, lower in (
        ("position RMSE, median", "position RMSE m", 0.0, "m", None),
        ("position RMSE, worst run", "worst run m", 0.25, "m", None),
        ("heading RMSE, median", "heading RMSE deg", 1.5, "degrees", None),
        ("NEES, mean", "NEES", 6.0, "", 1.0),
    )
]

_MAPPING = [
    Target(
        f"mapping of {log} with {algorithm}: {what}",
        "mapping.mapping",
        read_last(column, log=log, **{"with": algorithm}),
        limit,
        unit,
        at_least=at_least,
    )
    for log in ("intel", "freiburg-079")
    for algorithm, what, column, limit, unit, at_least in (
        *(
            (algorithm, what, column, limit, unit, at_least)
            for algorithm, steps, steps_deg, revisits, revisits_deg in (
                ("gmapping", 0.07, 1.5, 0.20, 2.0),
                ("graph", 0.05, 1.0, 0.10, 1.0),
            )
            for what, column, limit, unit, at_least in (
                ("steps", "steps m", steps, "m", False),
                ("steps", "deg", steps_deg, "degrees", False),
                ("revisits", "revisits m", revisits, "m", False),
                ("revisits", "rev. deg", revisits_deg, "degrees", False),
                ("occupied cells by those of the reference", "walls x", 1.05, "x", False),
                ("scans a second on one core, reading included", "scans/s", 50, "/s", True),
            )
        ),
        ("amcl", "aligned", "aligned m", 0.10, "m", False),
        ("amcl", "heading over steps", "deg", 1.5, "degrees", False),
    )
]

_EXPLORATION = [
    Target(
        f"exploration of the demo's floor with {algorithm}: {what}",
        "exploration.exploration",
        read_last(column, **{"with": algorithm}),
        limit,
        unit,
        at_least=at_least,
    )
    for algorithm in ("gmapping", "graph")
    for what, column, limit, unit, at_least in (
        ("free floor that is known, worst run", "explored %", 99, "%", True),
        ("cells that are right, worst run", "right %", 99, "%", True),
        ("error of walls, worst run", "walls mm", 25, "mm", False),
        ("contacts", "contacts", 0, "contacts", False),
    )
]

DAY_TASKS_PER_HOUR = 1800.0
"""Least that the fleet of the ``day`` does: nine tenths of what it did when this was measured first."""

ABUSE_P99_MS = 20.0
"""Most that another user's abuse may make of the round trips of a robot's 100 Hz probe."""
ABUSE_MORE_MS = 100.0
"""Most that the maximum may be above that without abuse."""
_ABUSE = [
    Target(
        f"a robot's 100 Hz probe beside another user's abuse, {kind}, {what}",
        "abuse",
        read_last(column, abuse=kind),
        limit,
        "ms",
    )
    for what, column, limit in (
        ("p99", "p99 ms", ABUSE_P99_MS),
        ("maximum, more than without", "max, more than none ms", ABUSE_MORE_MS),
    )
    for kind in attacks.KINDS
]

_STORE = [
    Target("etcd, three members: a save of one row, p50", "store.save", read_last("p50_ms", rows=1), 3, "ms"),
    Target(
        "etcd, three members: a save of 64 rows, p99", "store.save", read_last("p99_ms", rows=64), 30, "ms"
    ),
    Target(
        "etcd beside idle masters, each member", "store.idle", read_last("cores_percent"), 2, "% of a core"
    ),
    Target("etcd beside idle masters, each member, PSS", "store.idle", read_last("PSS MB"), 100, "MB"),
]
_SCALE = [
    Target(
        f"1000 machines, 100 000 containers in the master's state: {what}",
        f"scale.{suite}",
        read_last(column, machines=1000),
        limit,
        unit,
    )
    for suite, what, column, limit, unit in (
        ("placing", "create a container, CPU, p50", "create p50, ms", 1, "ms"),
        ("placing", "a machine of 100 is lost and all are placed again, CPU", "lost, ms", 100, "ms"),
        ("placing", "the longest slice of that", "longest slice, ms", 20, "ms"),
        ("placing", "the longest slice when 40 machines are lost", "its longest, ms", 20, "ms"),
        ("placing", "a tick when nothing happens, CPU", "tick, ms", 20, "ms"),
        ("store", "load from the store, CPU", "load, s", 2.8, "s"),
        ("store", "size of the store", "stored, MB", 40, "MB"),
        ("store", "memory of the tables", "tables, MB", 147, "MB"),
    )
]
_SCALE.append(
    Target(
        "the longest that a command of 2000 robots or of a full queue holds the master's loop, CPU",
        "scale.holds",
        read_greatest("longest, ms"),
        20,
        "ms",
    )
)

_DAY = [
    Target(
        f"100 robots do tasks for 600 s, planner killed twice: {what}",
        "day.run",
        read_last(column, robots=100),
        limit,
        unit,
        at_least=at_least,
    )
    for what, column, limit, unit, at_least in (
        ("the run is ok (1)", "ok", 1, "", True),
        ("tasks lost", "tasks lost", 0, "tasks", False),
        ("longest standstill", "longest standstill s", 60, "s", False),
        ("tasks done", "tasks/h", DAY_TASKS_PER_HOUR, "/h", True),
    )
]

TARGETS = [
    *_ROUND_TRIPS,
    *_IN_TLS,
    *_ABUSE,
    Target(
        "messages of 64 B, 32 in flight, converter",
        "rate",
        read_last("messages/s", path="converter"),
        6000,
        "/s",
        at_least=True,
    ),
    Target(
        "memory with a robot and an echo container, sum of PSS",
        "memory",
        read_last("PSS MB", process="sum"),
        100,
        "MB",
    ),
    Target("fan-out to 200 at 20 Hz, p95", "fanout", read_last("p95_ms", clients=200), 20, "ms"),
    Target(
        "1000 robots join one container: control bytes of the last hundred, 1.0 is linear",
        "joining",
        read_last("x first hundred (bytes)", robots=1000),
        1.1,
        "x first hundred",
    ),
    Target(
        "1000 robots join one container: CPU of the last hundred, 1.0 is linear",
        "joining",
        read_last("x first hundred (CPU)", robots=1000),
        1.3,
        "x first hundred",
    ),
    Target(
        "a robot task set ends: its 200 robots are at another one, with all that they had",
        "failover",
        read_greatest("seconds until all are elsewhere", robots=200, target=failover.TARGET_S),
        2,
        "s",
    ),
    Target(
        "a robot task set is drained: the same",
        "failover",
        read_greatest(
            "seconds until all are elsewhere", **{"robot task set": failover.DRAINED, "robots": 200}
        ),
        2,
        "s",
    ),
    Target(
        "a robot task set hangs: the same",
        "failover",
        read_greatest("seconds until all are elsewhere", **{"robot task set": failover.HUNG, "robots": 200}),
        20,
        "s",
    ),
    Target(
        "one client stalls: what the others get",
        "stalled",
        read_last("share %", phase="it still stalls"),
        95,
        "%",
        at_least=True,
    ),
    *(
        Target(
            f"a pose of a driving robot at the planner, {robots} robots",
            "fleet.planner",
            read_last("driving, us per pose", robots=robots),
            50,
            "us",
        )
        for robots in (50, 2000)
    ),
    Target(
        "operator's page and fleet manager, script ms per frame with 1000 robots",
        "station.page",
        read_last("script ms per frame", robots=1000),
        16.7,
        "ms",
    ),
    Target(
        "operator's page with a graphics card, frames/s with 1000 robots",
        "station.page",
        read_last("frames/s, graphics card", robots=1000),
        60,
        "/s",
        at_least=True,
    ),
    *_DAY,
    *_PLANS,
    Target(
        "the planner's tick with 1000 robots, all in, CPU, p99",
        "traffic.tick",
        read_last("p99 ms", robots=1000),
        100,
        "ms",
    ),
    Target(
        "a cell is blocked: work until the last of 1000 robots has its new path, CPU, worst of 20",
        "traffic.block",
        read_greatest("ms", robots=1000),
        100,
        "ms",
    ),
    Target(
        "1000 tasks are given to 1000 idle robots, CPU, least of 7",
        "assignment.choose",
        read_last("ms", robots=1000),
        60,
        "ms",
    ),
    Target(
        "1000 tasks on a new grid: longest stop of the fleet manager for distances, CPU",
        "assignment.choose",
        read_last("new grid, longest slice ms", robots=1000),
        50,
        "ms",
    ),
    *(
        Target(
            f"simulated world, 100 robots with {sensor}s, one core, best of 5 passes",
            "simulation.world",
            read_last("x real time", robots=100, sensor=sensor),
            1,
            "x real time",
            at_least=True,
        )
        for sensor in ("lidar", "camera")
    ),
    *(
        Target(
            f"1000 light robots without the engine, {what}, one core",
            suite,
            read_last("x real time", robots=1000),
            2.24,
            "x real time",
            at_least=True,
        )
        for what, suite in (
            ("world alone", "light.world"),
            ("with planner and move clients", "light.fleet"),
        )
    ),
    Target(
        "simulated world with ROS nodes, 100 robots with lidars, one core, best of 5 passes",
        "simulation.nodes",
        read_last("x real time", robots=100),
        1,
        "x real time",
        at_least=True,
    ),
    *(
        Target(
            f"navigation, {what}",
            "navigation.drive",
            read_last(column, sampling="pursuit"),
            limit,
            unit,
            at_least=at_least,
        )
        for what, column, limit, unit, at_least in (
            ("contacts by the robot's own motion", "contacts", 0, "contacts", False),
            ("goals with a way that are reached", "reached %", 99, "%", True),
            ("median path by the shortest", "path / shortest", 1.15, "x", False),
            ("control step at 10 Hz, CPU, p99", "step p99 ms", 10, "ms", False),
        )
    ),
    *(
        Target(
            f"amcl: an update, 500 particles x 60 beams, {form}, median",
            "localization.update",
            read_last("likelihood_field p50 ms", form=form),
            limit,
            "ms",
        )
        for form, limit in (("numpy", 0.8), ("compiled", 0.25))
    ),
    *_LOCALIZATION,
    *_MAPPING,
    *_EXPLORATION,
    Target(
        "amcl, global localization right within 30 s",
        "localization.global",
        read_last("right in time %", robot="anywhere"),
        95,
        "%",
        at_least=True,
    ),
    Target(
        "amcl, a kidnapped robot right again within 60 s",
        "localization.kidnapped",
        read_last("right in time %", robot="kidnapped"),
        90,
        "%",
        at_least=True,
    ),
    *_SCALE,
    *_STORE,
    Target("container start to first message, p50", "start", read_last("p50_ms"), 250, "ms"),
    Target("100 containers at once", "many", read_last("all at once", containers=100), 20, "s"),
    Target("idle container, PSS", "many", read_last("idle container PSS MB"), 15, "MB"),
    Target("slowest ROS tool at our core", "ros.tools", read_greatest("ratio"), tools.TARGET, "x rosmaster"),
]


def beside_targets(part: str, suites: Mapping[str, Rows]) -> Iterator[dict[str, Any]]:
    """Yield rows that show what a part has measured beside its targets.

    Args:
        part: Name of the part.
        suites: Its rows, by suite.
    """
    for target in TARGETS:
        own, _, suite = target.suite.partition(".")
        figure = target.read(suites.get(suite, ())) if own == part else None
        if figure is not None:
            met = "met" if target.is_met(figure) else "missed"
            yield {
                "figure": target.what,
                "measured": figure,
                "target": target.wanted,
                "": met,
            }
