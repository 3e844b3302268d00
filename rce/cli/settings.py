"""Makes a program's options from the engine's settings, and reads the settings from the command line.

A program lists the settings that are its options; each program also has ``--config FILE`` and
``--settings JSON``. Later ones override earlier ones: defaults, file, document, options. Example::

    OPTIONS = SettingsOptions("robot", "container.package_path", "secret_file", "dev")

    @app.command()
    @OPTIONS.given("rce-robot")
    def robot(settings: EngineSettings) -> None: ...
"""

from __future__ import annotations

import inspect
import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import wraps
from pathlib import Path
from typing import Annotated, Any

import typer

from rce.config import (
    ConfigError,
    EngineSettings,
    Fault,
    Field,
    SettingError,
    fields_of,
    load_settings,
    read_document,
    sections_of,
)

COMMON = ("dev", "secret_file", "machine", "log_level", "log_dir", "log_size", "log_count")
"""Settings that are options of every program of the engine."""
MASTER_IP = "MASTER_IP"

_PANELS = {
    "": "Engine",
    "master": "Master",
    "robot": "Robot endpoints",
    "container": "Containers",
    "tls": "TLS",
}


@dataclass(frozen=True, slots=True)
class SettingOption:
    """An option for a setting.

    Attributes:
        place: Section and name; the section is empty for settings that all programs share.
        name: Name of the option, without dashes.
    """

    place: tuple[str, str]
    field: Field
    name: str

    @property
    def parameter(self) -> str:
        """Name of the function's parameter."""
        return "_".join(filter(None, (*self.place, "option")))

    @property
    def help(self) -> str:
        """Help text with the default."""
        shown = self.field.shown_default
        unset = f" (default: {shown})" if shown and not self.field.is_flag else ""
        again = " May be repeated." if self.field.is_list else ""
        return (self.field.setting.help + again + unset).replace("`", "")

    def declare(self, *, panel: str | None = None) -> inspect.Parameter:
        """Return the parameter for Typer."""
        flag = self.field.is_flag
        names = [f"--{self.name}" + (f"/--no-{self.name}" if flag and self.name != "dev" else "")]
        option = typer.Option(
            *names,
            help=self.help,
            metavar=None if flag else self.field.metavar,
            rich_help_panel=panel,
            show_default=False,
        )
        kind: Any = bool | None if flag else list[str] | None if self.field.is_list else str | None
        return _parameter(self.parameter, kind, option)

    def read(self, value: Any) -> Any:
        """Return the value on the command line.

        Raises:
            typer.BadParameter: The value is not valid.
        """
        try:
            return self.field.read(value, text=True)
        except SettingError as error:
            raise typer.BadParameter(f"--{self.name} {error}") from None


class SettingsOptions:
    """The options of a program that set settings.

    Args:
        places: Sections, settings of a section (``master.control_port``), or settings that all programs
            share.
        master: Whether the program's argument is the master's address.
        up: Use the option names of ``rce up``; only some settings have one.
    """

    def __init__(self, *places: str, master: bool = False, up: bool = False) -> None:
        self.options = tuple(option for place in places for option in _options(place, up=up))
        self._master = master
        self._up = up

    def given(self, program: str) -> Callable[[Callable[..., None]], Callable[..., None]]:
        """Return the decorator of a command whose first parameter is the engine's settings.

        Args:
            program: Name of the program, for errors.
        """

        def decorate(function: Callable[..., None]) -> Callable[..., None]:
            signature = inspect.signature(function, eval_str=True)
            own = [
                each.replace(kind=inspect.Parameter.KEYWORD_ONLY)
                for each in list(signature.parameters.values())[1:]
            ]

            @wraps(function)
            def command(**values: Any) -> None:
                mine = {each.name: values.pop(each.name) for each in self.parameters()}
                function(self.read(program, mine), **values)

            parameters = [*self.parameters(), *own]
            command.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
            command.__annotations__ = {each.name: each.annotation for each in parameters}
            del command.__wrapped__
            return command

        return decorate

    def parameters(self) -> list[inspect.Parameter]:
        """Return the parameters for Typer."""
        declared = [option.declare(panel=self._panel(option)) for option in self.options]
        if self._master:
            help_ = (
                "Host or address of the master, HOST or HOST:PORT; of several masters, all of them separated"
                " by commas [master_host of the settings file, also a list]."
            )
            declared.insert(
                0, _parameter("master", str | None, typer.Argument(metavar=MASTER_IP, help=help_))
            )
        if self._up:
            help_ = "Settings file (YAML), same as --config; see configs/engine.yaml."
            declared.insert(0, _parameter("file", Path | None, typer.Argument(metavar="FILE", help=help_)))
        help_ = "Settings file (YAML); options override it."
        declared.append(
            _parameter("config", Path | None, typer.Option("--config", metavar="FILE", help=help_))
        )
        help_ = "Settings as a JSON document; override those of the file."
        option = typer.Option("--settings", metavar="JSON", help=help_)
        return [*declared, _parameter("document", str | None, option)]

    def read(self, program: str, values: dict[str, Any]) -> EngineSettings:
        """Return the settings from the parameters that Typer parsed.

        Args:
            program: The program's name, for errors.
            values: The values of :meth:`parameters`.

        Raises:
            typer.BadParameter: An option is not valid.
            typer.Exit: The file or the document is not valid; the errors were printed.
        """
        if values["config"] is not None and values.get("file") is not None:
            raise typer.BadParameter("give one settings file, as FILE or as --config")
        over = [self._from_options(values)]
        try:
            if values["document"] is not None:
                over.insert(0, read_document(_parse(values["document"]), "--settings"))
            settings = load_settings(values["config"] or values.get("file"), *over)
        except ConfigError as error:
            typer.echo("\n".join(f"{program}: {line}" for line in str(error).splitlines()), err=True)
            raise typer.Exit(2) from None
        if self._master and not settings.master_host:
            raise typer.BadParameter(f"give {MASTER_IP}, or master_host in the settings file")
        return settings

    def _from_options(self, values: dict[str, Any]) -> dict[str, Any]:
        found: dict[str, Any] = {}
        for option in self.options:
            value = values[option.parameter]
            if value is None or value in ([], ()):
                continue
            section, name = option.place
            (found.setdefault(section, {}) if section else found)[name] = option.read(value)
        if self._master and values["master"] is not None:
            try:
                found["master_host"] = fields_of(EngineSettings)["master_host"].read(values["master"])
            except SettingError as error:
                raise typer.BadParameter(f"{MASTER_IP} {error}") from None
        return found

    def _panel(self, option: SettingOption) -> str | None:
        return _PANELS.get(option.place[0]) if self._up else None


def _parameter(name: str, kind: Any, said: Any) -> inspect.Parameter:
    keyword = inspect.Parameter.KEYWORD_ONLY
    return inspect.Parameter(name, keyword, default=None, annotation=Annotated[kind, said])


def _options(place: str, *, up: bool) -> Iterator[SettingOption]:
    section, _, name = place.rpartition(".")
    sections = sections_of(EngineSettings)
    if place in sections:
        section, name = place, ""
    fields = fields_of(sections[section] if section else EngineSettings)
    for field in (fields[name],) if name else fields.values():
        setting = field.setting
        called = (
            setting.up if up else field.name.replace("_", "-") if setting.option is None else setting.option
        )
        if called:
            yield SettingOption((section, field.name), field, called)


def _parse(document: str) -> Any:
    try:
        return json.loads(document)
    except json.JSONDecodeError as error:
        place = f"line {error.lineno}, column {error.colno}"
        raise ConfigError("--settings", [Fault(place, f"not valid JSON: {error.msg}")]) from None
