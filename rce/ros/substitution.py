"""``$(find PKG)`` and ``$(env VAR)`` in nodes' arguments and in string parameters.

The texts are never passed to a shell.
"""

from __future__ import annotations

import re
import shlex
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping

    from rce.ros.packages import PackageIndex

_EXPRESSION = re.compile(r"\$\(([^()]*)\)")
_OPEN = re.compile(r"\$\(")
_MARK = "\0"
_MARKED = re.compile(f"{_MARK}(\\d+){_MARK}")


class SubstitutionError(ValueError):
    """A substitution cannot be made; the text says why."""


def substitute(text: str, packages: PackageIndex, environ: Mapping[str, str]) -> str:
    """Replace every ``$(find PKG)`` by the folder of a package and ``$(env VAR)`` by an environment variable.

    Inserted text is not searched again. All other text, a lone ``$`` too, stays as it is.

    Raises:
        SubstitutionError: An expression is neither of the two, is not closed, or names something unknown.
    """
    result = _EXPRESSION.sub(lambda match: _evaluate(match[1], packages, environ), text)
    # Inserted text may hold anything, so the fault is searched in the original text.
    if _OPEN.search(_EXPRESSION.sub("", text)):
        raise SubstitutionError(f"a '$(' without ')' in {text!r}")
    return result


def split_arguments(text: str, packages: PackageIndex, environ: Mapping[str, str]) -> list[str]:
    """Split arguments into words as a POSIX shell does, then substitute in each word.

    ``$(find PKG)`` is one part of a word in spite of its space, and inserted text always stays inside its
    word.

    Raises:
        SubstitutionError: A quote is not closed, or a substitution cannot be made.
    """
    if _MARK in text:
        raise SubstitutionError("arguments must not hold a NUL character")
    expressions: list[str] = []

    def hide(match: re.Match[str]) -> str:
        expressions.append(match[0])
        return f"{_MARK}{len(expressions) - 1}{_MARK}"

    try:
        words = shlex.split(_EXPRESSION.sub(hide, text))
    except ValueError as error:
        raise SubstitutionError(f"{str(error).lower()} in {text!r}") from error
    shown = (_MARKED.sub(lambda match: expressions[int(match[1])], word) for word in words)
    return [substitute(word, packages, environ) for word in shown]


def _evaluate(expression: str, packages: PackageIndex, environ: Mapping[str, str]) -> str:
    match expression.split():
        case ["find", package]:
            try:
                return str(packages.find(package).path)
            except LookupError as error:
                raise SubstitutionError(f"$({expression}): {error}") from error
        case ["env", variable]:
            if variable not in environ:
                raise SubstitutionError(f"$({expression}): there is no environment variable {variable}")
            return environ[variable]
        case _:
            raise SubstitutionError(f"$({expression}) is not known; use $(find PKG) or $(env VAR)")
