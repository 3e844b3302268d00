"""Substitution in launch files: ``$(find)``, ``$(arg)``, ``$(env)``, ``$(eval)`` and the others."""

from __future__ import annotations

import math
import os
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rce.ros.launch.exceptions import LaunchValueError
from rce.ros.launch.expressions import evaluate
from rce.ros.launch.values import convert

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from rce.ros.launch.inputs import LaunchInputs

_EXPRESSION = re.compile(r"\$\(([^()$][^()$]*)\)")
_OPEN = re.compile(r"\$\((?!\))")
_PATH_AFTER = re.compile(r"/(?P<path>[^\s]*)")
EVAL = "$(eval "
COMMANDS = ("anon", "arg", "dirname", "env", "eval", "find", "optenv")

_MATH = {name: value for name, value in vars(math).items() if not name.startswith("_")}
_TRUTHS = {"true": True, "false": False, "True": True, "False": False}
_BUILT_IN: dict[str, Callable[..., Any]] = {
    "float": float,
    "int": int,
    "list": list,
    "str": str,
}


class Substitution:
    """Substitutes in the texts of one part of a launch file.

    Args:
        inputs: Packages and environment variables.
        file: The launch file.
        arguments: Its arguments.
        anonymous: Names that ``$(anon)`` has made; more are added.
    """

    def __init__(
        self, inputs: LaunchInputs, file: str, arguments: Mapping[str, str], anonymous: dict[str, str]
    ) -> None:
        self._inputs = inputs
        self._file = file
        self._arguments = arguments
        self._anonymous = anonymous

    def resolve(self, text: str) -> str:
        """Return a text with everything substituted.

        Inserted text is searched for ``$(find)`` only, as ``roslaunch`` does.

        Raises:
            LaunchValueError: An expression is not known, or names something that is not there.
            LookupError: A package is not there.
        """
        if "$(" not in text:
            return text
        if text.startswith(EVAL) and text.endswith(")"):
            return str(self.evaluate(text[len(EVAL) : -1]))
        self._check(text)
        return self._insert_folders(_EXPRESSION.sub(self._insert, text))

    def evaluate(self, expression: str) -> Any:
        """Return the value of an expression, as in ``$(eval EXPRESSION)``.

        Raises:
            LaunchValueError: It cannot be evaluated.
        """
        if "__" in expression:
            raise LaunchValueError("$(eval ...) must not contain '__'")
        functions: dict[str, Callable[..., Any]] = {
            **_BUILT_IN,
            "anon": self._anon,
            "arg": lambda name: convert(self._arg(name), "auto"),
            "dirname": self._dirname,
            "env": self._env,
            "find": lambda package: str(self._inputs.find(package)),
            "optenv": lambda name, default="": self._inputs.environ.get(name, default),
        }
        functions.update({name: value for name, value in _MATH.items() if callable(value)})
        constants = {name: value for name, value in _MATH.items() if not callable(value)}
        arguments = {
            name: convert(value, "auto") for name, value in self._arguments.items() if name not in functions
        }
        return evaluate(expression, {**arguments, **_TRUTHS, **constants}, functions)

    def _check(self, text: str) -> None:
        if _OPEN.search(_EXPRESSION.sub("", text)):
            raise LaunchValueError(
                f"{text!r} has a '$(' that is not closed, or holds another '$' or '(';"
                " $(eval ...) must be the whole text"
            )

    def _insert(self, match: re.Match[str]) -> str:
        command, *words = match[1].split() or [""]
        if command == "eval":
            raise LaunchValueError(f"{match[0]}: $(eval ...) must be the whole text")
        if command not in COMMANDS:
            raise LaunchValueError(f"{match[0]} is not known; use one of {', '.join(COMMANDS)}")
        if command == "dirname":
            return self._dirname()
        if not words or (len(words) > 1 and command != "optenv"):
            raise LaunchValueError(f"{match[0]} has {len(words)} arguments, must have one")
        if command == "optenv":
            return self._inputs.environ.get(words[0], " ".join(words[1:]))
        if command == "find":
            return match[0]  # of the second round
        return {"anon": self._anon, "arg": self._arg, "env": self._env}[command](words[0])

    def _insert_folders(self, text: str) -> str:
        """Replace each ``$(find PKG)``; a file of the package that follows may be one of its programs."""
        parts, rest = "", text
        while (found := _EXPRESSION.search(rest)) is not None:
            command, *words = found[1].split() or [""]
            parts, rest = parts + rest[: found.start()], rest[found.end() :]
            if command != "find" or len(words) != 1:
                parts += found[0]
                continue
            folder = self._inputs.find(words[0])
            after = _PATH_AFTER.match(rest)
            program = self._program(folder, words[0], after["path"]) if after is not None else ""
            if program and after is not None:
                parts, rest = parts + program, rest[after.end() :]
            else:
                parts += str(folder)
        return parts + rest

    def _program(self, folder: Path, package: str, path: str) -> str:
        """Return a program that an installed package keeps in ``lib``; empty if it is in the folder."""
        installed = folder.parent.parent / "lib" / package / Path(path).name
        is_apart = folder.parent.name == "share" and not self._inputs.is_file(str(folder / path))
        return str(installed) if path and is_apart and self._inputs.is_file(str(installed)) else ""

    def _arg(self, name: str) -> str:
        if name not in self._arguments:
            raise LaunchValueError(
                f"argument {name} is not set; give {name}:=VALUE, or a default in <arg name={name!r}>"
            )
        return self._arguments[name]

    def _env(self, name: str) -> str:
        if name not in self._inputs.environ:
            raise LaunchValueError(f"$(env {name}): there is no environment variable {name}")
        return self._inputs.environ[name]

    def _anon(self, prefix: str) -> str:
        if prefix not in self._anonymous:
            self._anonymous[prefix] = self._inputs.anonymous_name(prefix)
        return self._anonymous[prefix]

    def _dirname(self) -> str:
        return os.path.dirname(os.path.abspath(self._file))  # noqa: PTH100, PTH120 - as roslaunch: not resolved
