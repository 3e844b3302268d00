"""What an experiment is: set-ups that are run again and again, and what is measured in each."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, ClassVar, NamedTuple

from rce_fleet.experiments.results import Condition
from rce_fleet.experiments.systems.base import Layout, System
from rce_fleet.experiments.systems.registry import system_of
from rce_fleet.experiments.systems.software import SOFTWARES, USUAL, software_of

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from rce_fleet.experiments.bench import Bench
    from rce_fleet.experiments.measures import Value

SETTLE_S = 0.5
"""From the beginning of a condition to its measurement, seconds."""
START_S = 5.0
"""About how long a system takes to start and to end, seconds."""
PAPER_SYSTEMS = ("single_master", "multi_master", "cloud")
NETBOOK_CORES = 0.2
"""The share of a core that stands for the robot's netbook.

A TurtleBot's netbook has an Atom of 2010 with two cores of 1.8 GHz. By published single-thread ratings such a
core does about an eighth of what a present server's core does; the second one adds about half as much for
nodes that wait for each other. The machine that measures is not the one of the ratings: the share is an
assumption, and 0.15 to 0.25 would be as good.
"""


class Link(NamedTuple):
    """The client's link.

    Attributes:
        rate: Mbit/s in each direction.
        delay: Milliseconds in each direction.
    """

    rate: float
    delay: float

    @property
    def factors(self) -> dict[str, str]:
        """The factors of conditions that are measured over it."""
        return {"rate": f"{self.rate:g}", "delay": f"{self.delay:g}"}


@dataclass(frozen=True, slots=True)
class Options:
    """How experiments are done.

    Attributes:
        systems: Names of the systems that are compared.
        software: Names of the software of robots; all is measured with the first one, the main conditions
            with each.
        robots: Number of robots, where an experiment does not say.
        seconds: How long a condition is measured.
        quick: Whether only what shows that everything works is measured.
    """

    systems: tuple[str, ...] = PAPER_SYSTEMS
    software: tuple[str, ...] = USUAL
    robots: int = 5
    seconds: float = 3.0
    quick: bool = False

    def has_all(self, setup: Condition) -> bool:
        """Return whether all conditions are measured with a set-up's software, not only the main ones."""
        return not self.quick and setup.software == self.software[0]


class Measured(NamedTuple):
    """A value of a condition."""

    condition: Condition
    value: Value


@dataclass(slots=True)
class Trial:
    """One run of a set-up.

    Attributes:
        setup: The set-up.
        options: How experiments are done.
        seed: Of everything random in it.
        is_warm_up: Whether it does not count: what takes long may be left out.
        prepared: What the experiment's preparation found.
    """

    setup: Condition
    options: Options
    seed: int
    is_warm_up: bool = False
    prepared: dict[str, float] = field(default_factory=dict)

    def system(self, bench: Bench, layout: Layout | None = None) -> System:
        """Return the set-up's system on a bench."""
        kind = system_of(self.setup.system)
        return kind(bench, software_of(self.setup.software), layout or Layout())

    def condition(self, **factors: object) -> Condition:
        """Return a condition of the set-up with further factors."""
        setup = self.setup
        return Condition.of(setup.experiment, setup.system, setup.software, **dict(setup.factors) | factors)

    def measured(self, values: Iterable[Value], **factors: object) -> list[Measured]:
        """Return values of a condition of the set-up."""
        condition = self.condition(**factors)
        return [Measured(condition, value) for value in values]


class Experiment(ABC):
    """An experiment."""

    name: ClassVar[str]
    title: ClassVar[str]
    """What it measures, in a line."""
    programs: ClassVar[tuple[str, ...]] = ()
    """Programs of the experiments that the software of robots must have."""
    at_once: ClassVar[int] = 1
    """How many of its runs are done at the same time: more than one disturb each other's figures, unless they
    wait most of the time, and neither work nor delays are measured."""

    def possible(self, options: Options) -> Options:
        """Return the options with only the software that has all of the experiment's programs."""
        return replace(options, software=tuple(one for one in options.software if not self.lacking(one)))

    def lacking(self, software: str) -> list[str]:
        """Return the programs of the experiment that a software does not have."""
        return SOFTWARES[software].lacking(self.programs) if software in SOFTWARES else []

    @abstractmethod
    def setups(self, options: Options) -> list[Condition]:
        """Return what is started once in each run."""

    def links(self, options: Options) -> Sequence[Link]:
        """Return the links that it needs beside the usual ones; they are measured first, too."""
        del options
        return ()

    @abstractmethod
    def seconds(self, setup: Condition, options: Options) -> float:
        """Return about how long a run of a set-up takes."""

    def warm_up_seconds(self, setup: Condition, options: Options) -> float:
        """Return about how long the run takes that does not count."""
        del setup
        return START_S + SETTLE_S + options.seconds

    @abstractmethod
    async def measure(self, trial: Trial) -> list[Measured]:
        """Run a set-up once.

        Raises:
            ExperimentError: It cannot be done; the text says why.
        """

    def preparation_seconds(self, options: Options) -> float:
        """Return about how long the preparation takes."""
        del options
        return 0.0

    async def prepare(self, options: Options, seed: int) -> list[Value]:
        """Find out what all runs need to know, once.

        Raises:
            ExperimentError: It cannot be done.
        """
        del options, seed
        return []

    def each(self, options: Options, *, software: Iterable[str] | None = None) -> list[Condition]:
        """Return a set-up for each system and software."""
        return [
            Condition.of(self.name, system, name)
            for name in (options.software if software is None else software)
            for system in options.systems
        ]
