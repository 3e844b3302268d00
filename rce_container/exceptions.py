"""The errors of the Container Task Set.

ContainerError
├── RuntimeUnavailableError   no runtime of that name works on this machine
├── StartError                a container could not be started
│   └── VolumeError           a volume of it cannot be used
├── NetworkError              a container cannot be joined to its network
├── KillError                 a container could not be ended
├── LimitError                a limit of a container could not be put in force
├── LimitsUnavailableError    a way to enforce limits does not work on this machine
├── ExecutionError            a command cannot be run in a container
└── StateError                the state directory cannot be used
"""

from __future__ import annotations


class ContainerError(Exception):
    """Base of all errors of this package."""


class RuntimeUnavailableError(ContainerError):
    """The chosen runtime does not work on this machine."""

    def __init__(self, runtime: str, reason: str) -> None:
        super().__init__(runtime, reason)
        self.runtime = runtime
        self.reason = reason

    def __str__(self) -> str:
        return f"the runtime {self.runtime!r} does not work here: {self.reason}"


class StartError(ContainerError):
    """A container could not be started; the text says what to do."""


class VolumeError(StartError):
    """A volume of a container cannot be used; the text says what to do."""


class NetworkError(ContainerError):
    """A container cannot be joined to its network; the text says why."""


class KillError(ContainerError):
    """Processes of a container do not end, even after SIGKILL."""


class LimitError(ContainerError):
    """A limit of a container could not be applied; the text says what to do."""


class LimitsUnavailableError(ContainerError):
    """A way to enforce limits does not work on this machine; the text says why."""


class ExecutionError(ContainerError):
    """A command cannot be run in a container; the text says why."""


class StateError(ContainerError):
    """The state directory cannot be used; the text says why."""


class StateBusyError(StateError):
    """Another task set uses the state directory."""
