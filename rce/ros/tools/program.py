"""The commands as a command line, for the graph that ``ROS_MASTER_URI`` names."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import sys
from collections.abc import Awaitable, Callable
from typing import Annotated, Concatenate, ParamSpec

import typer

from rce.printable import for_terminal
from rce.ros import names
from rce.ros.errors import RosError, ToolError
from rce.ros.node import Node, run
from rce.ros.node.master import MasterClient
from rce.ros.tools import parameters, services, topics
from rce.ros.tools.topics import WINDOW, ToolContext
from rce.ros.types import TypeRegistry
from rce.ros.types.exceptions import TypesError
from rce.ros.xmlrpc import RpcClient

P = ParamSpec("P")

topic = typer.Typer(no_args_is_help=True, help="List, show, measure and publish topics.")
service = typer.Typer(no_args_is_help=True, help="List, show and call services.")
param = typer.Typer(no_args_is_help=True, help="Read and set parameters.")
app = typer.Typer(no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False)
app.add_typer(topic, name="topic")
app.add_typer(service, name="service")
app.add_typer(param, name="param")

Name = Annotated[str, typer.Argument(show_default=False)]
Values = Annotated[str, typer.Argument(help="Fields as YAML, such as '{data: hello}'.")]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON object a line.")]


INTERRUPTED = 130
"""Exit code of a command that was interrupted before it was done, as of shells after SIGINT."""


def _watch(
    work: Callable[Concatenate[ToolContext, P], Awaitable[None]], *args: P.args, **kwargs: P.kwargs
) -> None:
    """Run a command that goes on until it is interrupted; as :func:`_do` else."""
    with contextlib.suppress(_InterruptedError):
        _run(work, *args, **kwargs)


def _do(
    work: Callable[Concatenate[ToolContext, P], Awaitable[None]], *args: P.args, **kwargs: P.kwargs
) -> None:
    """Run a command with a node of its own; print why if it fails.

    Raises:
        typer.Exit: It failed, with code 1, or was interrupted, with code 130.
    """
    try:
        _run(work, *args, **kwargs)
    except _InterruptedError:
        raise typer.Exit(INTERRUPTED) from None


class _InterruptedError(Exception):
    """A signal came before the command was done."""


def _run(
    work: Callable[Concatenate[ToolContext, P], Awaitable[None]], *args: P.args, **kwargs: P.kwargs
) -> None:
    logging.basicConfig(level=logging.ERROR, format="%(message)s")
    try:
        run(_with_node(lambda context: work(context, *args, **kwargs)))
    except (ToolError, RosError, TypesError, TimeoutError) as error:
        typer.echo(str(error) or "no answer in time", err=True)
        raise typer.Exit(1) from None
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise typer.Exit(1) from None


class _ToolNode(Node):
    """A node that takes every global name: masters and other nodes know names that are not legal."""

    def resolve(self, name: str) -> str:
        """Return the global name that ``name`` stands for.

        Raises:
            InvalidNameError: It is a relative or private name that is not legal.
        """
        return names.canonical(name) if names.is_global(name) else super().resolve(name)


async def _with_node(work: Callable[[ToolContext], Awaitable[None]]) -> None:
    types = TypeRegistry()
    async with (
        _ToolNode("rce_tool", argv=[], types=types, anonymous=True, signals=True, rosout=False) as node,
        RpcClient() as rpc,
    ):
        master = MasterClient(uri=node.master_uri, caller=node.name, slave_uri=node.uri, rpc=rpc)
        command = asyncio.ensure_future(work(ToolContext(node, master, rpc, types, _show)))
        told = asyncio.ensure_future(node.spin())
        done, _ = await asyncio.wait((command, told), return_when=asyncio.FIRST_COMPLETED)
        for task in (told, command):
            task.cancel()
        await asyncio.wait((told, command))
        if command not in done:
            raise _InterruptedError
        command.result()


def _show(text: str) -> None:
    sys.stdout.write(f"{for_terminal(text) if sys.stdout.isatty() else text}\n")
    sys.stdout.flush()


@topic.command("list")
def topic_list(
    verbose: Annotated[
        bool, typer.Option("--verbose", "-v", help="Show types, and how many nodes publish and subscribe.")
    ] = False,
) -> None:
    """List the topics."""
    _do(topics.list_topics, verbose=verbose)


@topic.command("info")
def topic_info(name: Name) -> None:
    """Show a topic's type, publishers and subscribers."""
    _do(topics.info, name)


@topic.command("type")
def topic_type(name: Name) -> None:
    """Show a topic's type."""
    _do(topics.show_type, name)


@topic.command("echo")
def topic_echo(
    name: Name,
    count: Annotated[int, typer.Option("-n", min=0, help="End after so many messages; 0: never.")] = 0,
    json: Json = False,
    whole: Annotated[bool, typer.Option("--whole", help="Do not cut long arrays.")] = False,
    no_arrays: Annotated[bool, typer.Option("--noarr", help="Leave arrays out.")] = False,
) -> None:
    """Print a topic's messages."""
    run_echo = _do if count else _watch
    run_echo(topics.echo, name, count=count, json=json, whole=whole, no_arrays=no_arrays)


@topic.command("hz")
def topic_hz(
    name: Name,
    window: Annotated[int, typer.Option("--window", "-w", min=2, help="Messages to average over.")] = WINDOW,
    interval: Annotated[float, typer.Option(min=0.1, help="Seconds between two lines.")] = 1.0,
    count: Annotated[int, typer.Option("-n", min=0, help="End after so many lines; 0: never.")] = 0,
) -> None:
    """Print a topic's rate."""
    run_hz = _do if count else _watch
    run_hz(topics.hz, name, window=window, interval=interval, count=count)


@topic.command("pub")
def topic_pub(
    name: Name,
    kind: Annotated[
        str, typer.Argument(metavar="TYPE", help="package/Type; '' for the one that the graph knows.")
    ],
    values: Values = "",
    rate: Annotated[float, typer.Option("--rate", "-r", min=0, help="Times a second; 0: once.")] = 0.0,
    latch: Annotated[bool, typer.Option("--latch", "-l", help="Keep it for later subscribers.")] = False,
) -> None:
    """Publish on a topic."""
    run_pub = _watch if rate or latch else _do
    run_pub(topics.publish, name, kind, values, rate=rate, latch=latch)


@service.command("list")
def service_list() -> None:
    """List the services."""
    _do(services.list_services)


@service.command("type")
def service_type(name: Name) -> None:
    """Show a service's type."""
    _do(services.show_type, name)


@service.command("call")
def service_call(
    name: Name,
    values: Values = "",
    json: Json = False,
    timeout: Annotated[float, typer.Option(min=0.1, help="Seconds to wait for the response.")] = 30.0,
) -> None:
    """Call a service and print its response."""
    _do(services.call, name, values, json=json, timeout=timeout)


@param.command("list")
def param_list(namespace: Annotated[str, typer.Argument(help="Only of this namespace.")] = "/") -> None:
    """List the parameters."""
    _do(parameters.list_parameters, namespace)


@param.command("get")
def param_get(name: Name, json: Json = False) -> None:
    """Print a parameter or a namespace."""
    _do(parameters.get, name, as_json=json)


@param.command("set")
def param_set(name: Name, value: Annotated[str, typer.Argument(help="A YAML value.")]) -> None:
    """Set a parameter or a namespace."""
    _do(parameters.set_value, name, value)


@param.command("delete")
def param_delete(name: Name) -> None:
    """Delete a parameter or a namespace."""
    _do(parameters.delete, name)


def main(arguments: list[str] | None = None) -> None:
    """Run a command, such as ``["topic", "list"]``; None for the program's own arguments."""
    app(arguments, prog_name="rce")
