"""The ``rce`` program: its commands are entry points of the installed packages.

A package adds a command by an entry point of the group ``rce.commands``: the entry point's name is the
command, its value a function, a :class:`Plugged` or a :class:`typer.Typer` of subcommands. So ``rce`` imports
nothing above it.
"""

from __future__ import annotations

import sys
from importlib.metadata import EntryPoint, entry_points
from typing import TYPE_CHECKING, Any, NamedTuple

import typer

from rce import __version__
from rce.cli.programs import missing_for
from rce.cli.summaries import summary_of
from rce.own_process import escape_missing_letters, open_missing_streams

if TYPE_CHECKING:
    from collections.abc import Callable

GROUP = "rce.commands"
INTERRUPTED = 130
"""Exit code after Ctrl-C, as shells have it."""


class Plugged(NamedTuple):
    """A command with its own command-line settings."""

    function: Callable[..., None]
    settings: dict[str, Any]
    """For :class:`click.Context`, such as ``allow_interspersed_args``."""


def _version(asked: bool) -> None:
    if asked:
        typer.echo(f"rce {__version__}")
        raise typer.Exit


def _root(
    version: bool = typer.Option(
        False, "--version", callback=_version, is_eager=True, help="Print the version."
    ),
) -> None:
    """RCE, a cloud robotics engine: run and inspect it, drive a fleet."""


def build_app(points: list[EntryPoint], *, listing: bool = False) -> typer.Typer:
    """Return the program with the given commands.

    Args:
        points: The commands.
        listing: Import only commands that are run, and those whose source does not say their help text.
    """
    app = typer.Typer(no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False)
    app.callback()(_root)
    for point in points:
        problem = missing_for(point.module)
        if problem is not None:
            _add_unavailable(app, point.name, problem)
            continue
        if listing and (summary := summary_of(point.module, point.attr)):
            _add_listed(app, point, summary)
            continue
        try:
            plugged: Any = point.load()
        except ModuleNotFoundError as error:  # of a package that is installed in part
            if error.name is None or error.name.startswith("rce"):
                raise
            _add_unavailable(app, point.name, f"the package {error.name} is missing")
            continue
        if isinstance(plugged, typer.Typer):
            app.add_typer(plugged, name=point.name)
        elif isinstance(plugged, Plugged):
            app.command(name=point.name, context_settings=plugged.settings)(plugged.function)
        else:
            app.command(name=point.name)(plugged)
    return app


def _add_listed(app: typer.Typer, point: EntryPoint, summary: str) -> None:
    """Add a command that is imported when it is run, such as by ``rce -- ps``."""

    @app.command(
        point.name,
        help=summary,
        add_help_option=False,
        context_settings={"allow_extra_args": True, "ignore_unknown_options": True},
    )
    def listed(context: typer.Context) -> None:
        build_app([point])([point.name, *context.args], prog_name="rce")


def _add_unavailable(app: typer.Typer, name: str, problem: str) -> None:
    """Add a command that only reports its missing package, so that the others work without it."""

    @app.command(
        name,
        help=f"Not available: {problem}.".replace("[", r"\["),  # typer reads brackets as markup
        context_settings={"allow_extra_args": True, "ignore_unknown_options": True},
    )
    def unavailable() -> None:
        typer.echo(f"rce {name}: {problem}", err=True)
        raise typer.Exit(1)


def main() -> None:
    """Run the ``rce`` program. If the first word is a command, only this one is imported.

    Ctrl-C while a command is imported ends the program without a traceback.
    """
    open_missing_streams()
    escape_missing_letters()
    points = sorted(entry_points(group=GROUP), key=lambda point: point.name)
    asked = [point for point in points if point.name == sys.argv[1]] if len(sys.argv) > 1 else []
    try:
        app = build_app(asked or points, listing=not asked)
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)
    app(prog_name="rce")
