"""``rce launch``: the nodes of a launch file, without a ROS installation."""

from __future__ import annotations

import asyncio
import logging
import os
import shlex
from pathlib import Path
from typing import Annotated, Any

import typer
import uvloop

from rce.config import start_logging
from rce.own_process import end_signals
from rce.ros.cli.run import known_packages
from rce.ros.errors import PackageError
from rce.ros.launch import LaunchError, LaunchPlan, MachineInputs, load_launch_files
from rce.ros.launch.inputs import find_launch_file
from rce.ros.launching import Launcher, StopTimeouts
from rce.ros.launching.command import node_command
from rce.ros.launching.graph import parameters_as_yaml
from rce.ros.logfiles import log_folder
from rce.ros.node.settings import DEFAULT_MASTER_URI
from rce.ros.packages import PackageIndex

ASSIGN = ":="


def launch(
    what: Annotated[
        list[str],
        typer.Argument(
            metavar="[PKG] FILE... [ARG:=VALUE]...",
            help="Launch files, or a package and a file of it; values of their arguments.",
        ),
    ],
    nodes: Annotated[bool, typer.Option("--nodes", help="List the nodes; start none.")] = False,
    dump_params: Annotated[bool, typer.Option(help="Print the parameters as YAML; start no node.")] = False,
    args: Annotated[
        str, typer.Option(metavar="NODE", help="Print the command line of a node; start none.")
    ] = "",
    ros_args: Annotated[bool, typer.Option(help="List the arguments of the files; start no node.")] = False,
    files: Annotated[bool, typer.Option("--files", help="List the files with those they include.")] = False,
    screen: Annotated[bool, typer.Option("--screen", help="Show the output of all nodes.")] = False,
    log: Annotated[bool, typer.Option(help="Write the logs of the run into a folder of its own.")] = True,
    wait: Annotated[bool, typer.Option("--wait", help="Wait for the master; do not start one.")] = False,
    one_process: Annotated[
        bool,
        typer.Option("--one-process", help="Run nodes of Python packages in this process, to save memory."),
    ] = False,
    port: Annotated[
        int,
        typer.Option(
            "--port",
            "-p",
            min=0,
            max=65535,
            help="Port of a master on this machine; default: ROS_MASTER_URI.",
        ),
    ] = 0,
    sigint_timeout: Annotated[
        float, typer.Option(help="Seconds that a node may take to end on SIGINT.")
    ] = 15.0,
    sigterm_timeout: Annotated[
        float, typer.Option(help="Seconds that a node may take to end on SIGTERM, which comes next.")
    ] = 2.0,
) -> None:
    """Start the nodes of a launch file."""
    inputs = MachineInputs(known_packages())
    uri = _master_uri(port)
    if one_process:
        handler = logging.StreamHandler()
        handler.setLevel(logging.WARNING)  # nodes' own loggers let more pass
        start_logging(logging.WARNING, line="%(levelname)s %(name)s: %(message)s", handler=handler)
    try:
        plan = _load(what, inputs)
        for warning in plan.warnings:
            typer.echo(f"warning: {warning}", err=True)
        if _explain(plan, nodes=nodes, parameters=dump_params, arguments=ros_args, files=files):
            return
        if args:
            _print_command(plan, inputs.packages, uri, args)
            return
        timeouts = StopTimeouts(sigint_timeout, sigterm_timeout)
        code = uvloop.run(
            _launch(
                plan, inputs, uri, timeouts, logs=log, waits=wait, shows_all=screen, one_process=one_process
            )
        )
    except LaunchError as error:
        typer.echo(f"rce launch: {error}", err=True)
        raise typer.Exit(1) from error
    raise typer.Exit(code)


def _master_uri(port: int) -> str:
    if port:
        return f"http://127.0.0.1:{port}/"
    return os.environ.get("ROS_MASTER_URI") or DEFAULT_MASTER_URI


def _load(what: list[str], inputs: MachineInputs) -> LaunchPlan:
    values = dict(word.split(ASSIGN, 1) for word in what if ASSIGN in word)
    names = [word for word in what if ASSIGN not in word]
    special = {name: value for name, value in values.items() if name.startswith("_")}
    if unknown := sorted(special.keys() - {"__ns"}):
        raise LaunchError(f"{unknown[0]}:= is not an argument of launch files; only __ns:= is known")
    namespace = special.get("__ns") or inputs.environ.get("ROS_NAMESPACE") or "/"
    arguments = {name: value for name, value in values.items() if name not in special}
    return load_launch_files(_files(names, inputs), arguments, inputs=inputs, namespace=namespace)


def _files(names: list[str], inputs: MachineInputs) -> list[str]:
    """Return the launch files that a command line names: a package and a file of it, or paths."""
    if not names:
        raise LaunchError("give a launch file, or a package and one of its launch files")
    missing = [name for name in names if not Path(name).is_file()]
    if not missing:
        return names
    if len(names) != 2:  # noqa: PLR2004 - a package and a file
        raise LaunchError(f"there is no file {missing[0]}")
    try:
        return [str(find_launch_file(inputs.find(names[0]), names[1]))]
    except (PackageError, ValueError) as error:
        raise LaunchError(f"there is no file {missing[0]}; {error}") from error


def _explain(
    plan: LaunchPlan,
    *,
    nodes: bool,
    parameters: bool,
    arguments: bool,
    files: bool,
) -> bool:
    """Print what is asked for instead of a launch; return whether anything was."""
    if nodes:
        typer.echo("\n".join(node.name for node in plan.nodes))
    if parameters:
        typer.echo(parameters_as_yaml(plan.parameters), nl=False)
    if arguments:
        for one in plan.arguments.values():
            needed = "must be given" if one.default is None else f"default {one.default!r}"
            typer.echo(f"{one.name}: {needed}" + (f"; {one.doc}" if one.doc else ""))
    if files:
        typer.echo("\n".join(plan.files))
    return nodes or parameters or arguments or files


def _print_command(plan: LaunchPlan, packages: PackageIndex, uri: str, name: str) -> None:
    node = next((node for node in plan.nodes if node.name.strip("/") == name.strip("/")), None)
    if node is None:
        known = ", ".join(node.name for node in plan.nodes) or "none"
        raise LaunchError(f"there is no node {name}; the nodes are: {known}")
    try:
        command = node_command(node, packages, os.environ, uri)
    except PackageError as error:
        raise LaunchError(f"{node.place}: {error}") from error
    changed = [f"{key}={value}" for key, value in command.env.items() if os.environ.get(key) != value]
    typer.echo(shlex.join([*changed, *command.argv]))


async def _launch(
    plan: LaunchPlan, inputs: MachineInputs, uri: str, timeouts: StopTimeouts, *, logs: bool, **options: Any
) -> int:
    folder = log_folder(inputs.environ) if logs else None
    launcher = Launcher(plan, inputs.packages, uri, folder, report=typer.echo, timeouts=timeouts, **options)
    for number in end_signals():
        asyncio.get_running_loop().add_signal_handler(number, launcher.stop)
    return await launcher.run()
