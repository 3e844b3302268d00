"""``--config FILE`` of the programs whose settings are their options, such as ``rce discovery``.

The settings file has a section for each, by the command's name, and in it a key for each option: its name
with ``_`` for ``-``; for an argument, its name in the help. Later ones override earlier ones: default,
file, environment variable, option. Example::

    @from_file("discovery", leave_out=("list",))
    def discovery(name: Annotated[str, typer.Option(help="...")] = "") -> None: ...
"""

from __future__ import annotations

import difflib
import inspect
from collections.abc import Callable, Collection, Mapping
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rce.config import ConfigError, EngineSettings, Fault, load_settings
from rce.config.documents import parse, read_file

if TYPE_CHECKING:
    from collections.abc import Iterator

CONFIG = "settings_file"
_OWN = (CONFIG, "help")

Shared = Callable[[EngineSettings], Mapping[str, Any]]
"""Returns values for the program's parameters from the engine's settings."""


def from_file(
    section: str, *, leave_out: Collection[str] = (), shared: Shared | None = None
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Return the decorator that gives a command ``--config``.

    Args:
        section: Section of the file; one of :data:`rce.config.settings.PROGRAM_SECTIONS`.
        leave_out: Options that are not settings.
        shared: Returns values of other sections; those of the program's own section override them.
    """

    def on_config(ctx: typer.Context, value: Path | None) -> Path | None:
        if value is None:
            return None
        try:
            ctx.default_map = _read(ctx, value, section, leave_out, shared)
        except ConfigError as error:
            lines = str(error).splitlines()
            typer.echo("\n".join(f"{ctx.command_path}: {line}" for line in lines), err=True)
            raise typer.Exit(2) from None
        return value

    # Typer evaluates the callback's annotations, which are strings in this module.
    on_config.__annotations__ = {"ctx": typer.Context, "value": Path | None}

    def decorate(function: Callable[..., None]) -> Callable[..., None]:
        option = typer.Option(
            "--config",
            metavar="FILE",
            is_eager=True,
            callback=on_config,
            help=f"Settings file (YAML) with a section {section}; options override it.",
        )
        parameter = inspect.Parameter(
            CONFIG,
            inspect.Parameter.KEYWORD_ONLY,
            default=None,
            annotation=Annotated[Path | None, option],
        )
        signature = inspect.signature(function, eval_str=True)
        own = [each.replace(kind=inspect.Parameter.KEYWORD_ONLY) for each in signature.parameters.values()]

        @wraps(function)
        def command(**values: Any) -> None:
            del values[CONFIG]
            function(**values)

        parameters = [*own, parameter]
        command.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        command.__annotations__ = {each.name: each.annotation for each in parameters}
        command.leave_out = frozenset(leave_out)  # type: ignore[attr-defined]
        del command.__wrapped__
        return command

    return decorate


def keys_of(command: Any, leave_out: Collection[str] = ()) -> dict[str, Any]:
    """Return the parameters of a command that are settings, by their key in the file."""
    return {key: each for key, each in _named(command) if each.name not in _OWN and key not in leave_out}


def _named(command: Any) -> Iterator[tuple[str, Any]]:
    for each in command.params:
        if each.param_type_name == "argument":
            yield (each.metavar or each.name).lower(), each
        else:
            longest = next((name for name in each.opts if name.startswith("--")), "--")
            yield longest.removeprefix("--").replace("-", "_"), each


def _read(
    ctx: typer.Context, path: Path, section: str, leave_out: Collection[str], shared: Shared | None
) -> dict[str, Any]:
    settings = load_settings(path)
    values = dict(shared(settings)) if shared is not None else {}
    given = (parse(read_file(path), str(path)) or {}).get(section)
    if given is None:
        return values
    if not isinstance(given, dict):
        raise ConfigError(str(path), [Fault(section, f"must be a mapping, found {given!r:.40}")])
    keys = keys_of(ctx.command, leave_out)
    faults = []
    for key, value in given.items():
        place = f"{section}.{key}"
        if key not in keys:
            close = difflib.get_close_matches(str(key), keys, 1, 0.5)
            hint = f"; did you mean {close[0]!r}?" if close else ""
            faults.append(Fault(place, f"is not a known key{hint}"))
        elif value is not None:
            try:
                values[keys[key].name] = _checked(ctx, keys[key], value)
            except typer.BadParameter as error:
                faults.append(Fault(place, f"{str(error).rstrip('.')}, found {value!r:.40}"))
            except ValueError as error:
                faults.append(Fault(place, str(error)))
    if faults:
        raise ConfigError(str(path), faults)
    return values


def _checked(ctx: typer.Context, parameter: Any, value: Any) -> Any:
    """Return a value of the file in the form of the command line.

    Raises:
        typer.BadParameter: The value is not valid.
        ValueError: It has another type.
    """
    several = parameter.multiple or parameter.nargs != 1
    if several and not isinstance(value, list):
        value = [value]
    if isinstance(value, dict) or (isinstance(value, list) and not several):
        raise ValueError(f"must be one value, found {value!r:.40}")
    is_flag = getattr(parameter, "is_flag", False)
    if is_flag != isinstance(value, bool):
        raise ValueError(
            f"must {'be true or false' if is_flag else 'not be true or false'}, found {value!r:.40}"
        )
    if not is_flag:
        value = [str(each) for each in value] if several else str(value)
    parameter.process_value(ctx, value)
    return value
