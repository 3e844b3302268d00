"""What a supervisor keeps running."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field


@dataclass(frozen=True, slots=True)
class Program:
    """A program to keep running. It prints a line holding ``ready:`` once it can be used."""

    name: str
    argv: Sequence[str]
    env: Mapping[str, str] = field(default_factory=dict)
    final: Sequence[str] = ()
    """A command that removes what the program leaves if it is killed. It runs after the program's last end if
    that was not a proper one, and also when the supervisor itself is killed."""
    module: str = ""
    """The Python package that :attr:`argv` runs, if the program may be a fork of its supervisor: its
    ``__main__`` has a function ``main`` that takes no arguments, and reads ``sys.argv``."""

    @classmethod
    def of(cls, name: str, module: str, *arguments: str, env: Mapping[str, str]) -> Program:
        """Return a program that is a Python package of the engine."""
        return cls(name, [sys.executable, "-P", "-m", module, *arguments], env, module=module)

    @property
    def arguments(self) -> Sequence[str]:
        """What follows the module on the command line."""
        return self.argv[self.argv.index(self.module) + 1 :]
