"""The plan of a supervisor, and its handover from the program that read the command line to a small one.

The readers of command lines and settings take 10 MB, which the supervisor would hold for as long as it runs.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, NoReturn

from rce.supervision.title import set_title


@dataclass(frozen=True, slots=True)
class Program:
    """A program to keep running."""

    name: str
    argv: Sequence[str]
    env: Mapping[str, str] = field(default_factory=dict)
    final: Sequence[str] = ()
    """A command that cleans up after the program if it is killed. It runs after the program's last end if
    that was not a proper one, and also when the supervisor itself is killed."""
    module: str = ""
    """The Python package that :attr:`argv` runs, if the program may be a fork of its supervisor: its
    ``__main__`` has a function ``main`` that takes no arguments, and reads ``sys.argv``."""
    ready: str = " ready: "
    """Part of the line that it prints once it can be used."""

    @classmethod
    def of(
        cls, name: str, module: str, *arguments: str, env: Mapping[str, str], ready: str = " ready: "
    ) -> Program:
        """Return a program that is a Python package of the engine."""
        argv = [sys.executable, "-P", "-m", module, *arguments]
        return cls(name, argv, env, module=module, ready=ready)

    @property
    def arguments(self) -> Sequence[str]:
        """The arguments after the module on the command line."""
        return self.argv[self.argv.index(self.module) + 1 :]


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """The programs of an engine, and the lines to print."""

    programs: tuple[Program, ...]
    shared: tuple[str, ...] = ()
    """Python modules that the programs load."""
    ready: tuple[str, ...]
    """Lines to show once all are up."""
    warnings: tuple[str, ...] = ()
    """Lines to show at once, as errors are."""
    certified: dict[str, Any] = field(default_factory=dict)
    """The engine's settings as a document, if its certificates are to be kept; empty without TLS."""

    def hand_over(self) -> NoReturn:
        """Become the supervisor of this plan, in this process; the memory of loaded modules is released.

        Raises:
            OSError: The interpreter cannot be started, or the plan cannot be written.
        """
        from tempfile import TemporaryFile  # takes 1 MB, which the supervisor does not need

        with TemporaryFile() as file:
            file.write(json.dumps(asdict(self)).encode())
            file.seek(0)
            os.set_inheritable(file.fileno(), True)
            # The command line is for users who look for the process; its last word reserves room for forks.
            room = "-" * max(len("".join(program.argv)) for program in self.programs)
            os.execv(  # noqa: S606 - this interpreter
                sys.executable,
                [sys.executable, "-P", "-m", "rce.supervision", str(file.fileno()), *sys.argv, room],
            )

    @classmethod
    def take_over(cls, fd: int) -> Plan:
        """Read the plan that :meth:`hand_over` left.

        Args:
            fd: The number of its file; it is closed.
        """
        with os.fdopen(fd, "rb") as file:
            found = json.load(file)
        set_title(sys.orig_argv[:-1], os.path.basename(sys.executable))  # noqa: PTH119 - as in titles
        return cls(
            programs=tuple(Program(**program) for program in found["programs"]),
            shared=tuple(found["shared"]),
            ready=tuple(found["ready"]),
            warnings=tuple(found["warnings"]),
            certified=found["certified"],
        )
