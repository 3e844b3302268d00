"""From which rate of the link on a task is faster in the cloud than on the robot."""

from __future__ import annotations

from collections import defaultdict
from math import isnan
from typing import TYPE_CHECKING

from rce_fleet.experiments.report.crossing import crossing_table
from rce_fleet.experiments.report.judging import is_above
from rce_fleet.experiments.report.labels import natural, software_label, system_label
from rce_fleet.experiments.report.measurements import Quantity
from rce_fleet.experiments.report.tables import MISSING, folded, markdown
from rce_fleet.experiments.statistics import MIN_RUNS

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rce_fleet.experiments.report.measurements import Measurements, Sample

TIME = Quantity("task_time")
NEVER = "at none that was measured"
NOT_JUDGED = f"not judged: fewer than {MIN_RUNS} runs"


def break_even_table(measurements: Measurements, experiment: str) -> str:
    """Return tables with the rate of the link from which on the cloud is faster, and where curves cross."""
    robot: dict[tuple[str, str], Sample] = {}
    robot_by_link: dict[tuple[str, str, str, str], Sample] = {}
    cloud: dict[tuple[str, str, str, str], dict[str, Sample]] = defaultdict(dict)
    for condition in measurements.conditions(experiment):
        factors = dict(condition.factors)
        sample = measurements.sample(condition, TIME)
        if sample is None:
            continue
        task, delay, rate = (factors.get(name, MISSING) for name in ("task", "delay", "rate"))
        if factors.get("place") == "robot":
            robot[condition.software, task] = sample
            robot_by_link[condition.software, task, delay, rate] = sample
        else:
            cloud[condition.system, condition.software, task, delay][rate] = sample
    rows = []
    for (system, software, task, delay), by_rate in cloud.items():
        # The robot's own time may be measured with each link, or once.
        others = {
            rate: found
            for rate in by_rate
            if (found := robot_by_link.get((software, task, delay, rate)) or robot.get((software, task)))
        }
        if others:
            names = (system_label(system), software_label(software), task, delay)
            rows.append([*names, first_faster(by_rate, others)])
    head = ("system", "software", "task", "delay", f"cloud is faster (`{TIME}`) from this rate on, Mbit/s")
    first = folded("Break-even", markdown(head, rows)) if rows else ""
    return "\n\n".join(filter(None, (first, crossing_table(measurements, experiment))))


def first_faster(cloud: Mapping[str, Sample], robot: Mapping[str, Sample]) -> str:
    """Return the lowest rate that the cloud is faster at, and at all higher ones; else that there is none."""
    found = ""
    for rate in sorted(robot, key=natural, reverse=True):
        if any(isnan(one[rate].estimate.low) for one in (robot, cloud)):
            return found or NOT_JUDGED
        if not is_above(robot[rate], cloud[rate]):
            break
        found = rate
    return found or NEVER
