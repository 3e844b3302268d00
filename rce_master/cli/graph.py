"""``rce topic``, ``rce service``, ``rce param``: the ROS graph of a container, or any other."""

from __future__ import annotations

from typing import NamedTuple

import typer

from rce.cli.main import Plugged
from rce.control.execution import Command

_CONTAINER, _USER = ("--container", "-c"), ("--user",)
_PASS_ON = {"ignore_unknown_options": True, "allow_extra_args": True, "help_option_names": list[str]()}
"""The arguments are those of :mod:`rce.ros.tools`."""


class Target(NamedTuple):
    """The target of a tool."""

    container: str
    """The container; empty: run here, for the graph that ROS_MASTER_URI names."""
    user: str
    arguments: tuple[str, ...]
    """The tool's arguments."""


def split(arguments: list[str]) -> Target:
    """Separate the container option from a tool's arguments.

    Raises:
        typer.BadParameter: An option lacks its value.
    """
    found, rest, left = {"container": "", "user": ""}, list[str](), list(arguments)
    while left:
        argument = left.pop(0)
        if argument == "--":
            rest += [argument, *left]
            break
        name, equals, value = argument.partition("=")
        key = "container" if name in _CONTAINER else "user" if name in _USER else ""
        if not key:
            rest.append(argument)
        elif equals:
            found[key] = value
        elif left:
            found[key] = left.pop(0)
        else:
            raise typer.BadParameter(f"{name} needs a value")
    return Target(found["container"], found["user"], tuple(rest))


def _run(tool: str, context: typer.Context) -> None:
    target = split(context.args)
    arguments = (tool, *target.arguments)
    if not target.container or "--help" in target.arguments:
        from rce.ros.tools.program import main

        if "--help" in target.arguments:
            typer.echo(
                "With -c CONTAINER anywhere: in that container; else for the graph of ROS_MASTER_URI.\n"
            )
        main(list(arguments))
        return
    from rce_master.cli.execute import run_command

    command = Command(argv=arguments, tool=True)
    code = run_command(target.container, command, user=target.user, stdin=False)
    raise typer.Exit(code)


def _topic(context: typer.Context) -> None:
    """Show topics of a container (-c) or of ROS_MASTER_URI, and publish on them."""
    _run("topic", context)


def _service(context: typer.Context) -> None:
    """Show and call services of a container (-c) or of ROS_MASTER_URI."""
    _run("service", context)


def _param(context: typer.Context) -> None:
    """Read and set parameters of a container (-c) or of ROS_MASTER_URI."""
    _run("param", context)


topic = Plugged(_topic, _PASS_ON)
service = Plugged(_service, _PASS_ON)
param = Plugged(_param, _PASS_ON)
