"""``rce run``: one node of a package, without a ROS installation."""

from __future__ import annotations

import contextlib
import os
import shlex
from typing import Annotated

import typer

from rce.cli.main import Plugged
from rce.config import ShippedFileError, configs_dir
from rce.ros.errors import PackageError
from rce.ros.node.settings import SHOW_WARNINGS
from rce.ros.packages import PackageIndex
from rce.ros.system import system_environ


def run(
    package: Annotated[str, typer.Argument(metavar="PKG", help="Package of the node.")],
    executable: Annotated[str, typer.Argument(metavar="EXE", help="Its executable.")],
    arguments: Annotated[
        list[str] | None,
        typer.Argument(metavar="[ARGUMENT]...", help="Its arguments, such as _rate:=5 or scan:=/front/scan."),
    ] = None,
    prefix: Annotated[str, typer.Option(help="Words before the command, such as 'nice -n 5'.")] = "",
) -> None:
    """Run one node of a package."""
    try:
        program = known_packages().find(package).program(executable)
        words = [*shlex.split(prefix), *program.command, *(arguments or [])]
    except (PackageError, ValueError) as error:
        typer.echo(f"rce run: {error}", err=True)
        raise typer.Exit(1) from error
    if program.choice:
        typer.echo(program.choice, err=True)
    environ = {SHOW_WARNINGS: "yes", **os.environ}
    if program.package.python == "system":
        environ = system_environ(environ, program.package.path)
    try:
        os.execvpe(words[0], words, environ)  # noqa: S606 - the node takes this program's place
    except OSError as error:
        typer.echo(f"rce run: {words[0]} cannot be started: {error.strerror}", err=True)
        raise typer.Exit(1) from error


run_command = Plugged(run, {"allow_interspersed_args": False, "ignore_unknown_options": True})


def known_packages() -> PackageIndex:
    """Return the machine's packages, and those of the shipped configs."""
    path = PackageIndex.of_machine().path
    with contextlib.suppress(ShippedFileError):
        path = (*path, configs_dir())
    return PackageIndex(path)
