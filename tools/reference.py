"""Makes the pages of settings, options and life cycles, and the shipped settings file, from the code.

``python -m tools.reference`` writes them (``make reference``); with ``--check`` it names those that are not
current, and ends with 1 if there are any.
"""

from __future__ import annotations

import sys
import textwrap
import tomllib
from collections.abc import Callable, Iterator
from enum import Enum
from functools import partial
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import typer.main

from rce.cli.main import GROUP, build_app
from rce.cli.program_files import keys_of
from rce.config.fields import Field, Section, fields_of, sections_of
from rce.config.settings import PROGRAM_SECTIONS, EngineSettings
from rce.ros.tools import program
from rce_client.ros_bridge.__main__ import app as rce_ros
from rce_container.command import app as rce_container
from rce_master.command import app as rce_master
from rce_robot.command import app as rce_robot
from tools import lifecycles

ROOT = Path(__file__).resolve().parent.parent
WIDTH = 110
TOOLS = {f"rce {tool}": getattr(program, tool) for tool in ("topic", "service", "param")}
"""Commands that pass their words on to others, by name, which have the options."""
TOOL_OPTIONS = (
    "| `--container`, `-c` | CONTAINER | Container; default: the graph of ROS_MASTER_URI. |",
    "| `--user` | USER | Whose container; administrators only. |",
)

YAML_HEAD = """\
# Settings of the engine, for `rce up --config FILE` and for the single programs. Made by `make reference`.
# Every setting is here with its default; leave out what you do not change.
# Times are in seconds. Memory and disk are in MB, or texts such as 8G. A port of 0 takes a free one.
"""

SETTINGS_HEAD = """\
# Settings

For operators of a server. This page is made from the code (`make reference`).

One YAML file sets everything: `rce up --config engine.yaml`, and the same file for `rce-master`, `rce-robot`
and `rce-container` on machines of their own. Each program takes what it needs. `configs/engine.yaml` holds
every setting with its default.

What comes later in this list counts:

1. the default,
2. the file (`--config FILE`),
3. development mode (`dev`, `--dev`): everything listens on loopback only,
4. a JSON document of the same keys (`--settings JSON`; `rce up` starts its programs with one),
5. single [options](options.md).

Times are in seconds. Memory and disk are numbers of MB, or texts such as `8G`. A port of 0 takes a free one.
A list's option is repeated. A file with unknown keys or values that do not fit is refused, and every fault is
listed."""

PROGRAMS_HEAD = """
## Other programs

`rce core`, `demo`, `discovery`, `relay`, `sync` and `ui` have a section each, whose settings are their
options. `--config FILE` reads it; an environment variable (where the [options](options.md) name one) and an
option win. The same file may hold the sections of all programs. `rce ui` takes the section `tls` too."""

OPTIONS_HEAD = """\
# Options

For operators and users of the command line. This page is made from the code (`make reference`). The settings
behind the options of the engine's programs are described in [settings](settings.md)."""


def shipped_file() -> str:
    """Return the settings file with every default."""
    parts = [YAML_HEAD, "\n", *_yaml(EngineSettings, "")]
    for name, section in sections_of(EngineSettings).items():
        parts += [f"\n# {_title(section)}\n{name}:\n", *_yaml(section, "  ")]
    for name, command in _programs_with_sections():
        parts.append(f"\n# `rce {name}`. {_first_line(command)}\n{name}:\n")
        for key, option in keys_of(command, command.callback.leave_out).items():
            start = "  # "
            parts.append(
                textwrap.fill(_help(option), WIDTH, initial_indent=start, subsequent_indent=start) + "\n"
            )
            parts.append(f"{start}{key}:{_example(option)}\n")
    return "".join(parts)


def _programs_with_sections() -> Iterator[tuple[str, Any]]:
    """Return the commands whose options are a section of the settings file."""
    rce = _rce()
    commands = typer.main.get_command(rce).commands  # type: ignore[attr-defined]  # it is a group of commands
    return ((name, commands[name]) for name in PROGRAM_SECTIONS)


def _first_line(command: Any) -> str:
    return " ".join(command.help.split())


def _help(option: Any) -> str:
    return " ".join((option.help or "").split()).replace("`", "")


def _example(option: Any) -> str:
    value = getattr(option.default, "value", option.default)
    if value is None or callable(value) or value == "":
        return ""
    return f" {str(value).lower() if isinstance(value, bool) else value}"


def settings_page() -> str:
    """Return the page of all settings."""
    parts = [SETTINGS_HEAD, *_settings_table("", EngineSettings, "Shared by all programs")]
    for name, section in sections_of(EngineSettings).items():
        parts += _settings_table(name, section, f"`{name}`: {_title(section)}")
    parts.append(PROGRAMS_HEAD)
    for name, command in _programs_with_sections():
        parts += [
            f"\n### `{name}`: {_first_line(command)}\n",
            "| setting | value | option | |",
            "|---|---|---|---|",
        ]
        for key, option in keys_of(command, command.callback.leave_out).items():
            names, kind, text = _cells(option)
            several = "list of " if option.multiple else ""
            said = names if option.param_type_name == "option" else ""
            parts.append(f"| `{name}.{key}` | {several}{kind or 'yes or no'} | {said} | {text} |")
    return "\n".join(parts).rstrip() + "\n"


def options_page() -> str:
    """Return the page of all programs, their commands and options."""
    programs = {
        "rce": _rce(),
        "rce-master": rce_master,
        "rce-robot": rce_robot,
        "rce-container": rce_container,
        "rce-ros": rce_ros,
    }
    parts = [OPTIONS_HEAD]
    for name, app in programs.items():
        parts += _commands(name, typer.main.get_command(app))
    return "\n".join(parts).rstrip() + "\n"


def _rce() -> typer.Typer:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    commands = project["entry-points"][GROUP]
    return build_app([EntryPoint(name, commands[name], GROUP) for name in sorted(commands)])


PAGES: dict[str, Callable[[], str]] = {
    "configs/engine.yaml": shipped_file,
    "docs/reference/settings.md": settings_page,
    "docs/reference/options.md": options_page,
    "docs/reference/lifecycles.md": lifecycles.page,
    **{place: partial(str, text) for place, text in lifecycles.pictures().items()},
}


def _title(section: type[Section]) -> str:
    return (section.__doc__ or "").partition("\n")[0]


def _yaml(section: type[Section], indent: str) -> Iterator[str]:
    for name, field in fields_of(section).items():
        said = field.setting.help + (f" Default: {field.setting.unset}." if field.setting.unset else "")
        start = f"{indent}# "
        yield textwrap.fill(said, WIDTH, initial_indent=start, subsequent_indent=start) + "\n"
        if field.setting.unset:
            example = field.setting.example
            yield f"{indent}# {name}:{f' {example}' if example else ''}\n"
        else:
            yield f"{indent}{name}: {_yaml_value(field)}\n"


def _yaml_value(field: Field) -> str:
    value = field.write(field.default)
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, list):
        return f"[{', '.join(value)}]"
    return field.shown_default or '""'


def _settings_table(place: str, section: type[Section], title: str) -> Iterator[str]:
    yield f"\n## {title}\n"
    yield "| setting | value | default | option | of `rce up` | |"
    yield "|---|---|---|---|---|---|"
    for name, field in fields_of(section).items():
        setting = field.setting
        option = name.replace("_", "-") if setting.option is None else setting.option
        default = setting.unset or (f"`{field.shown_default}`" if field.shown_default else "none")
        metavar = field.metavar.replace("|", r"\|")
        kind = f"list of {metavar}" if field.is_list else metavar
        cells = (
            f"`{place}{'.' if place else ''}{name}`",
            kind,
            default,
            f"`--{option}`" if option else "",
            f"`--{setting.up}`" if setting.up else "",
            setting.help,
        )
        yield f"| {' | '.join(cells)} |"


def _commands(name: str, command: Any) -> Iterator[str]:
    """Describe a command and those in it."""
    tool = TOOLS.get(name)
    inner = getattr(typer.main.get_command(tool) if tool else command, "commands", {})
    yield f"\n## `{name}`\n"
    if command.help:
        yield command.help.strip() + "\n"
    shown = (each for each in command.params if each.name != "help" and not getattr(each, "hidden", False))
    options = [*map(_option, shown), *(TOOL_OPTIONS if tool else ())]
    if options:
        yield "| option | value | |"
        yield "|---|---|---|"
        yield from options
    for each in inner.values():
        yield from _commands(f"{name} {each.name}", each)


def _option(option: object) -> str:
    return "| " + " | ".join(_cells(option)) + " |"


def _cells(option: Any) -> tuple[str, str, str]:
    """Return names, kind of value and sentence of an option or argument."""
    if option.param_type_name == "argument":
        names = f"`{option.metavar or option.name.upper()}`"
    else:
        names = ", ".join(f"`{name}`" for name in (*option.opts, *option.secondary_opts))
    kind = (
        ""
        if getattr(option, "is_flag", False)
        else option.metavar or _kind(option.type_descriptor.annotation)
    )
    variable = f" Environment: `{option.envvar}`." if getattr(option, "envvar", None) else ""
    default = getattr(option.default, "value", option.default)
    shown = option.show_default and kind and default not in (None, "", ()) and not callable(default)
    unset = f" (default: {default})" if shown else ""
    text = " ".join((option.help or "").split()) + unset + variable
    return names.replace("|", r"\|"), kind.replace("|", r"\|").replace("[", r"\["), text.replace("|", r"\|")


def _kind(annotation: object) -> str:
    if isinstance(annotation, type) and issubclass(annotation, Enum):
        return "|".join(str(each.value) for each in annotation)
    names = {"int": "NUMBER", "float": "NUMBER", "Path": "PATH", "str": "TEXT"}
    return names.get(getattr(annotation, "__name__", ""), "TEXT")


def main(check: bool) -> int:
    """Write the pages, or name those that are not current."""
    stale = 0
    for place, make in PAGES.items():
        path, text = ROOT / place, make()
        if path.exists() and path.read_text(encoding="utf-8") == text:
            continue
        stale += 1
        if check:
            print(f"{place} is not current: run `make reference`")  # noqa: T201 - its result
        else:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text, encoding="utf-8")
    return stale if check else 0


if __name__ == "__main__":
    sys.exit(1 if main("--check" in sys.argv[1:]) else 0)
