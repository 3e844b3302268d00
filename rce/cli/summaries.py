"""The help texts of commands for ``rce --help``, read in their sources: an import of all takes seconds."""

from __future__ import annotations

import ast
from collections.abc import Iterable
from importlib.util import find_spec
from pathlib import Path


def summary_of(module: str, name: str) -> str | None:
    """Return the help text of a command without importing it.

    Args:
        module: The command's module.
        name: What it is there: a function, a :class:`rce.cli.main.Plugged` or a :class:`typer.Typer`.

    Returns:
        The text; None if the source is not there or does not say it.

    Example::

        summary_of("rce_master.cli.show", "ps")  # "Show robots, containers, ..."
    """
    source = _source_of(module)
    if source is None:
        return None
    return _text_of(name, ast.parse(source).body)


def _source_of(module: str) -> str | None:
    package, *rest = module.split(".")
    spec = find_spec(package)  # of a module inside it would import the package
    for folder in (spec and spec.submodule_search_locations) or ():
        for path in (Path(folder, *rest).with_suffix(".py"), Path(folder, *rest, "__init__.py")):
            if path.is_file():
                return path.read_text("utf-8")
    return None


def _text_of(name: str, body: list[ast.stmt]) -> str | None:
    for statement in body:
        match statement:
            case ast.FunctionDef(name=found) if found == name:
                return ast.get_docstring(statement)
            case ast.Assign(targets=[ast.Name(id=found)], value=ast.Call() as call) if found == name:
                return _text_of_call(name, call, body)
    return None


def _text_of_call(name: str, call: ast.Call, body: list[ast.stmt]) -> str | None:
    match call:
        case ast.Call(func=ast.Name(id="Plugged"), args=[ast.Name(id=function), *_]):
            return _text_of(function, body)
        case ast.Call(func=ast.Attribute(attr="Typer"), keywords=keywords):
            values = (keyword.value for keyword in keywords if keyword.arg == "help")
            said = (str(value.value) for value in values if isinstance(value, ast.Constant))
            return next(said, None) or _text_of_callback(name, body)
        case _:
            return None


def _text_of_callback(app: str, body: Iterable[ast.stmt]) -> str | None:
    """Return the docstring of the function below ``@app.callback()``."""
    for statement in body:
        if isinstance(statement, ast.FunctionDef):
            decorators = map(ast.unparse, statement.decorator_list)
            if any(text.startswith(f"{app}.callback(") for text in decorators):
                return ast.get_docstring(statement)
    return None
