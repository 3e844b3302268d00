"""The experiments by name, in the order in which ``all`` does them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rce_fleet.exceptions import ExperimentError
from rce_fleet.experiments.images import Images
from rce_fleet.experiments.isolation import Isolation
from rce_fleet.experiments.laser import Laser
from rce_fleet.experiments.offload import Offload
from rce_fleet.experiments.robustness import Robustness
from rce_fleet.experiments.round_trip import RoundTrip
from rce_fleet.experiments.scaling import Scaling

if TYPE_CHECKING:
    from rce_fleet.experiments.experiment import Experiment

ALL = "all"
EXPERIMENTS: dict[str, Experiment] = {
    one.name: one for one in (Laser(), RoundTrip(), Images(), Scaling(), Robustness(), Isolation(), Offload())
}


def experiments_of(name: str) -> list[Experiment]:
    """Return an experiment by its name, or all.

    Raises:
        ExperimentError: There is none.
    """
    if name == ALL:
        return list(EXPERIMENTS.values())
    if name not in EXPERIMENTS:
        raise ExperimentError(f"there is no experiment {name}; there is {', '.join((*EXPERIMENTS, ALL))}")
    return [EXPERIMENTS[name]]
