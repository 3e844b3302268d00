"""Expressions of ``$(eval ...)``: arithmetic, comparisons and a few functions. Pure.

Nothing else can be reached. The grammar is Python's, read by :mod:`ast`; each kind of node has a rule.
"""

from __future__ import annotations

import ast
import operator
import re
from collections.abc import Callable, Mapping
from typing import Any

from rce.ros.launch.exceptions import LaunchValueError

MAX_LENGTH = 4096
"""Characters in an expression."""
MAX_BITS = 1024
"""Length of an integer that a power or a product makes; texts and lists have at most as many entries."""

_BINARY: Mapping[type[ast.operator], Callable[[Any, Any], Any]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.FloorDiv: operator.floordiv,
    ast.Mod: operator.mod,
    ast.Pow: operator.pow,
}
_UNARY: Mapping[type[ast.unaryop], Callable[[Any], Any]] = {
    ast.USub: operator.neg,
    ast.UAdd: operator.pos,
    ast.Not: operator.not_,
}
_COMPARISONS: Mapping[type[ast.cmpop], Callable[[Any, Any], Any]] = {
    ast.Eq: operator.eq,
    ast.NotEq: operator.ne,
    ast.Lt: operator.lt,
    ast.LtE: operator.le,
    ast.Gt: operator.gt,
    ast.GtE: operator.ge,
    ast.In: lambda one, many: one in many,
    ast.NotIn: lambda one, many: one not in many,
    ast.Is: operator.is_,
    ast.IsNot: operator.is_not,
}
_WIDE = re.compile(r"\*|\d{4}")
"""What makes a format's result as long as one likes."""
_TEXT_METHODS = frozenset(
    {
        *("endswith", "isdigit", "join", "lower", "lstrip", "replace"),
        *("rstrip", "split", "startswith", "strip", "title", "upper"),
    }
)


def evaluate(text: str, values: Mapping[str, Any], functions: Mapping[str, Callable[..., Any]]) -> Any:
    """Return the value of an expression.

    Args:
        text: The expression.
        values: What names stand for.
        functions: What may be called.

    Raises:
        LaunchValueError: It is not an expression, or uses what is not known or not allowed here.

    Example:
        >>> evaluate("2 * width if fast else 1", {"width": 3, "fast": True}, {})
        6
    """
    if len(text) > MAX_LENGTH:
        raise LaunchValueError(f"the expression has more than {MAX_LENGTH} characters")
    try:
        tree = ast.parse(text.strip(), mode="eval")
        return _Evaluation(values, functions).value(tree.body)
    except LaunchValueError:
        raise
    except SyntaxError as error:
        raise LaunchValueError(f"{text!r} is not an expression: {error.msg}") from error
    except (ArithmeticError, LookupError, RecursionError, TypeError, ValueError, MemoryError) as error:
        raise LaunchValueError(f"{text!r}: {error}") from error


class _Evaluation:
    def __init__(self, values: Mapping[str, Any], functions: Mapping[str, Callable[..., Any]]) -> None:
        self._values = values
        self._functions = functions

    def value(self, node: ast.expr) -> Any:
        """Return the value of a part of an expression."""
        match node:
            case ast.Constant(value=value):
                return value
            case ast.Name(id=name):
                return self._named(name)
            case ast.BoolOp(op=junction, values=parts):
                return self._joined(parts, is_and=isinstance(junction, ast.And))
            case ast.IfExp(test=test, body=body, orelse=other):
                return self.value(body if self.value(test) else other)
            case _:
                return self._of_values(node)

    def _of_values(self, node: ast.expr) -> Any:
        """Return the value of a part that needs the values of all its own parts."""
        found: Any
        match node:
            case ast.BinOp(left=left, op=sign, right=right) if type(sign) in _BINARY:
                found = self._combined(sign, self.value(left), self.value(right))
            case ast.UnaryOp(op=unary, operand=operand) if type(unary) in _UNARY:
                found = _UNARY[type(unary)](self.value(operand))
            case ast.Compare():
                found = self._compared(node)
            case ast.List(elts=entries):
                found = [self.value(entry) for entry in entries]
            case ast.Tuple(elts=entries):
                found = tuple(self.value(entry) for entry in entries)
            case ast.Subscript(value=whole, slice=part):
                found = self.value(whole)[self._index(part)]
            case ast.Call():
                found = self._called(node)
            case _:
                raise LaunchValueError(f"{ast.unparse(node)!r} is not allowed in $(eval ...)")
        return found

    def _named(self, name: str) -> Any:
        for known in (self._values, self._functions):
            if name in known:
                return known[name]
        raise LaunchValueError(f"{name} is neither an argument nor a function")

    def _combined(self, sign: ast.operator, left: Any, right: Any) -> Any:
        if isinstance(sign, ast.Mod) and isinstance(left, str) and _WIDE.search(left):
            raise LaunchValueError(f"the format {left!r} may be too long")
        if isinstance(sign, ast.Pow) and _bits(left) * abs(right) > MAX_BITS:
            raise LaunchValueError(f"{left} ** {right} is too large")
        if isinstance(sign, ast.Mult):
            many = next((one for one in (left, right) if isinstance(one, (str, list, tuple))), None)
            times = right if many is left else left
            if many is not None and isinstance(times, int) and len(many) * times > MAX_BITS:
                raise LaunchValueError("the product is too long")
        return _BINARY[type(sign)](left, right)

    def _joined(self, parts: list[ast.expr], *, is_and: bool) -> Any:
        found: Any = None
        for part in parts:
            found = self.value(part)
            if bool(found) is not is_and:
                break
        return found

    def _compared(self, node: ast.Compare) -> Any:
        left = self.value(node.left)
        found: Any = True
        for sign, part in zip(node.ops, node.comparators, strict=True):
            right = self.value(part)
            found = _COMPARISONS[type(sign)](left, right)
            if not found:
                break
            left = right
        return found

    def _index(self, part: ast.expr) -> Any:
        if isinstance(part, ast.Slice):
            ends = (part.lower, part.upper, part.step)
            return slice(*(None if end is None else self.value(end) for end in ends))
        return self.value(part)

    def _called(self, node: ast.Call) -> Any:
        if node.keywords:
            raise LaunchValueError("functions take no keywords in $(eval ...)")
        arguments = [self.value(argument) for argument in node.args]
        match node.func:
            case ast.Name(id=name) if name in self._functions:
                return self._functions[name](*arguments)
            case ast.Attribute(value=of, attr=name) if name in _TEXT_METHODS:
                subject = self.value(of)
                if isinstance(subject, str):
                    return getattr(subject, name)(*arguments)
        raise LaunchValueError(f"{ast.unparse(node.func)} cannot be called in $(eval ...)")


def _bits(value: Any) -> int:
    return max(value.bit_length(), 1) if isinstance(value, int) else 1
