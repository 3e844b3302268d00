"""Errors of the fleet system.

::

    FleetError
    +-- MapError            a map or scenario file that cannot be read
    +-- LanesError          a lane graph that does not fit its grid, or its file that cannot be read
    +-- LogError            a log of laser scans, or a trajectory, that cannot be read
    +-- PlanningError       a planning problem that is not well formed, or has no solution
    +-- PlannerError        a planner that is not installed or cannot be loaded
    +-- ScenarioError       no scenario of the requested size exists on the map
    +-- OccupiedError       a box cannot stand where a robot is
    +-- PlaceTakenError     a thing of the simulated world cannot stand where a robot or a walking person is
    +-- TransitionError     an event that the life cycle of a robot does not allow
    +-- InvariantError      the planner's records contradict each other: a bug
    +-- ZoneError           a zone that cannot be on the map
    +-- PlanWorkerError     the process that makes plans ended twice over one plan
    +-- BatchWorkerError    the process that looks for better queues gave no answer
    +-- TaskError           a request about a task that was not carried out
    |   +-- TaskRefusedError           the task cannot be carried out, or not be changed now
    |   +-- UnknownTaskError           there is no such task
    |   +-- RevisionError              the task was changed meanwhile
    |   +-- KeyReusedError             the requester's key belongs to another task
    +-- JournalError        the journal of the fleet manager cannot be read or written
    |   +-- JournalInUseError          another fleet manager has it open
    +-- StationError        a request to the operator station was not carried out
    |   +-- StationUnavailableError    station or planner cannot be reached; try again later
    |   +-- RequestRefusedError        the station refused the request
    |   +-- EventsForgottenError       a receiver of events is behind by more of them than are kept
    |   +-- EventsRestartedError       the fleet manager lost its journal: its events are numbered anew
    +-- ExperimentError     an experiment that cannot be done, or data of one that cannot be read
    +-- DemoError           errors of ``rce demo``, see rce_fleet.demo.exceptions
"""

from __future__ import annotations

from rce.lifecycle import InvalidTransitionError


class FleetError(Exception):
    """Base of the errors of the fleet system."""


class MapError(FleetError):
    """A map or scenario file cannot be read.

    Attributes:
        line: Number of the faulty line, from 1; 0 if the file as a whole is at fault.
        file: Its name, if it is known.
    """

    def __init__(self, reason: str, *, line: int = 0, file: str = "") -> None:
        self.reason = reason
        self.line = line
        self.file = file
        super().__init__(reason, line, file)

    def __str__(self) -> str:
        place = [self.file] if self.file else []
        if self.line:
            place.append(f"line {self.line}")
        return ": ".join((", ".join(place), self.reason)) if place else self.reason


class LanesError(FleetError, ValueError):
    """A lane graph cannot be driven on its grid, or its file cannot be read; the text says why and where."""


class PlanningError(FleetError, ValueError):
    """A planning problem is not well formed, or cannot be solved."""


class PlannerError(FleetError):
    """A planner is not installed or cannot be loaded."""


class ScenarioError(FleetError):
    """No scenario of the requested size exists on the map."""


class ZoneError(FleetError, ValueError):
    """A zone cannot be on the map; the text says why."""


class OccupiedError(FleetError):
    """A box cannot stand where a robot is.

    Attributes:
        cell: Where the box should have stood.
        robots: Ids of the robots in its way.
    """

    def __init__(self, cell: int, robots: tuple[str, ...]) -> None:
        self.cell = cell
        self.robots = robots
        super().__init__(cell, robots)

    def __str__(self) -> str:
        return f"cell {self.cell} cannot get a box: robot {', '.join(self.robots)} is in the way"


class PlaceTakenError(FleetError):
    """A robot, walking person or box of the simulated world cannot stand where something else is.

    Attributes:
        x: The place, metres.
        y: The place, metres.
        things: What is in the way: names of robots and walkers, or what it is.
    """

    def __init__(self, x: float, y: float, things: tuple[str, ...]) -> None:
        self.x = x
        self.y = y
        self.things = things
        super().__init__(x, y, things)

    def __str__(self) -> str:
        return f"({self.x:.2f}, {self.y:.2f}) is taken: {', '.join(self.things)} is in the way"


class TransitionError(InvalidTransitionError, FleetError):
    """An event that the life cycle of a robot or a move client does not allow; nothing was changed."""


class InvariantError(FleetError):
    """The planner's records contradict each other. Always a bug."""


class TaskError(FleetError):
    """A request about a task was not carried out; its text says why."""


class TaskRefusedError(TaskError):
    """The task cannot be carried out as it is described, or its state does not allow the request."""


class UnknownTaskError(TaskError):
    """There is no task, robot or other thing of this name."""


class PlannerSilentError(TaskError):
    """The planner has told nothing since the fleet manager began: try again."""


class RevisionError(TaskError):
    """The task was changed after the requester read it; read it again."""


class KeyReusedError(TaskError):
    """The requester used the key before, for a task with another content."""


class JournalError(FleetError):
    """The journal of the fleet manager cannot be read or written."""


class JournalInUseError(JournalError):
    """Another fleet manager has the journal open."""


class StationError(FleetError):
    """A request to the operator station was not carried out."""


class StationUnavailableError(StationError):
    """The station, or the planner behind it, cannot be reached now; try again later."""


class RequestRefusedError(StationError):
    """The station refused a request; its text says why."""


class EventsForgottenError(StationError):
    """A receiver of events is behind by more of them than the fleet manager keeps.

    Attributes:
        journal: Which journal numbers the events.
        first: Number of the first event that is not kept, of those that the receiver lacks.
        last: Number of the last one; the receiver continues after it.
    """

    def __init__(self, journal: str, first: int, last: int) -> None:
        self.journal, self.first, self.last = journal, first, last
        super().__init__(journal, first, last)

    def __str__(self) -> str:
        return (
            f"the events {self.first} .. {self.last} are not kept any more: read the tasks anew; events"
            f" follow from {self.last + 1} on"
        )


class EventsRestartedError(StationError):
    """The fleet manager lost its journal, or has an older one: its events are numbered anew.

    Attributes:
        journal: Which journal numbers the events now.
    """

    def __init__(self, journal: str) -> None:
        self.journal = journal
        super().__init__(journal)

    def __str__(self) -> str:
        return (
            "the fleet manager lost its journal: tasks and events from before are gone, and events are"
            " numbered from 1 again; read tasks and events anew"
        )


class PlanWorkerError(FleetError):
    """The process that makes plans ended twice over one plan.

    Attributes:
        number: Of the plan.
        robots: How many robots it was for.
        status: How the process ended the second time.
    """

    def __init__(self, number: int, robots: int, status: str) -> None:
        self.number = number
        self.robots = robots
        self.status = status
        super().__init__(number, robots, status)

    def __str__(self) -> str:
        return (
            f"plan {self.number} for {self.robots} robots was not made: the process that makes plans ended"
            f" twice over it ({self.status}); read its output, and check that the container has enough memory"
        )


class BatchWorkerError(FleetError):
    """The process that looks for better queues gave no answer."""


class LogError(FleetError):
    """A log of laser scans, or a trajectory, that cannot be read."""


class ExperimentError(FleetError):
    """An experiment cannot be done, or its data cannot be read."""
