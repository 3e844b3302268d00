"""Parts of figures as data: panels with series of samples, made from the measurements."""

from __future__ import annotations

from collections import Counter, defaultdict
from dataclasses import dataclass
from typing import TYPE_CHECKING

from rce_fleet.experiments.report.drawing import FURTHER_LOOKS, LOOKS, Look, look_of
from rce_fleet.experiments.report.labels import SYSTEMS, factors_label, natural, system_label

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from rce_fleet.experiments.report.measurements import Measurements, Quantity, Sample
    from rce_fleet.experiments.results import Condition

    Factors = tuple[tuple[str, str], ...]


@dataclass(frozen=True)
class Series:
    """A line or a row of bars.

    Attributes:
        label: Its name in the legend.
        look: How it is drawn.
        points: Names of the places on the axis, each with its sample.
        marked: Places whose bars have a mark.
    """

    label: str
    look: Look
    points: tuple[tuple[str, Sample], ...]
    marked: frozenset[str] = frozenset()

    @property
    def samples(self) -> list[Sample]:
        """The samples."""
        return [sample for _, sample in self.points]


@dataclass(frozen=True)
class Panel:
    """A part of a figure: what it is about, and its series."""

    title: str
    series: tuple[Series, ...]

    @property
    def samples(self) -> list[Sample]:
        """All samples."""
        return [sample for series in self.series for sample in series.samples]


def cases(
    measurements: Measurements, experiment: str, software: str
) -> list[tuple[str, dict[str, Condition]]]:
    """Return the conditions by system for each combination of factors, titled by the factors that vary."""
    mine = [one for one in measurements.conditions(experiment) if one.software == software]
    varying = _varying(mine)
    found: dict[Factors, dict[str, Condition]] = defaultdict(dict)
    for condition in mine:
        found[condition.factors][condition.system] = condition
    return [(_title(factors, varying), conditions) for factors, conditions in found.items()]


def panels_over(
    measurements: Measurements,
    experiment: str,
    software: str,
    across: str,
    quantity: Quantity,
    apart: Sequence[str] = (),
    moved: Mapping[tuple[str, str], tuple[str, str]] | None = None,
) -> list[Panel]:
    """Return panels with lines over a factor: a panel for each combination of the factors that remain.

    Args:
        measurements: The rows.
        experiment: The experiment.
        software: The software.
        across: The factor of the axis.
        quantity: What is drawn.
        apart: Factors that make lines of their own in a panel.
        moved: Factors whose lines are drawn in the panel of another value.
    """
    moved = moved or {}
    mine = [one for one in measurements.conditions(experiment) if one.software == software]
    varying = _varying(mine)
    lines: dict[Factors, dict[tuple[str, Factors], list[tuple[str, Sample]]]] = defaultdict(
        lambda: defaultdict(list)
    )
    for condition in mine:
        sample, place = measurements.sample(condition, quantity), dict(condition.factors).get(across)
        if sample is None or place is None:
            continue
        of_panel = tuple(
            moved.get(pair, pair) for pair in condition.factors if pair[0] not in {across, *apart}
        )
        of_line = tuple(
            pair for pair in condition.factors if pair in moved or (pair[0] in apart and pair[0] in varying)
        )
        lines[of_panel][condition.system, of_line].append((place, sample))
    return [Panel(_title(factors, varying), tuple(_series(found))) for factors, found in lines.items()]


def _series(lines: Mapping[tuple[str, Factors], list[tuple[str, Sample]]]) -> list[Series]:
    """Return the lines of a panel; further lines of a system get looks of their own."""
    found: list[Series] = []
    used = Counter[str]()
    is_one_system = len({system for system, _ in lines}) == 1
    for (system, factors), points in lines.items():
        if is_one_system:
            look = (*LOOKS.values(), *FURTHER_LOOKS)[len(found) % (len(LOOKS) + len(FURTHER_LOOKS))]
        elif used[system]:
            # A system's further line keeps its colour and differs by marker and line.
            further = FURTHER_LOOKS[(used[system] - 1) % len(FURTHER_LOOKS)]
            look = further._replace(colour=look_of(system).colour)
        else:
            look = look_of(system)
        used[system] += 1
        names = [system_label(system), *(f"{name}={value}" for name, value in factors)]
        label = ", ".join(names[1:] if is_one_system and factors else names)
        found.append(Series(label, look, tuple(sorted(points, key=_place))))
    return found


def image_panels(measurements: Measurements, software: str, quantities: Sequence[Quantity]) -> list[Panel]:
    """Return a panel for each quantity, with a place for each size and encoding of images.

    Other factors stand in a place's name where they are not as in most conditions.
    """
    mine = [one for one in measurements.conditions("images") if one.software == software]
    usual = _usual(mine)
    panels = []
    for quantity in quantities:
        systems: dict[str, list[tuple[str, Sample]]] = defaultdict(list)
        for condition in mine:
            if sample := measurements.sample(condition, quantity):
                systems[condition.system].append((_image_place(condition, usual), sample))
        series = tuple(
            Series(system_label(system), look_of(system), tuple(sorted(systems[system], key=_place)))
            for system in SYSTEMS
            if system in systems
        )
        panels.append(Panel(str(quantity), series))
    return panels


def _image_place(condition: Condition, usual: Mapping[str, str]) -> str:
    factors = dict(condition.factors)
    names = [factors.pop("size", "-"), factors.pop("encoding", "-")]
    unusual = [f"{name}={value}" for name, value in factors.items() if value != usual[name]]
    return "\n".join((*names, *unusual))


def _usual(conditions: Iterable[Condition]) -> dict[str, str]:
    """Return the value of each factor that most conditions have."""
    counts: dict[str, Counter[str]] = defaultdict(Counter)
    for condition in conditions:
        for name, value in condition.factors:
            counts[name][value] += 1
    return {name: found.most_common(1)[0][0] for name, found in counts.items()}


def _varying(conditions: Iterable[Condition]) -> frozenset[str]:
    """Return the factors that do not have the same value in all conditions."""
    values: dict[str, set[str]] = defaultdict(set)
    for condition in conditions:
        for name, value in condition.factors:
            values[name].add(value)
    return frozenset(name for name, found in values.items() if len(found) > 1)


def _title(factors: Factors, varying: Iterable[str]) -> str:
    shown = [pair for pair in factors if pair[0] in set(varying)]
    return factors_label(shown) if shown else ""


def _place(point: tuple[str, Sample]) -> tuple[object, ...]:
    return natural(point[0])
