"""The program ``rce-ros``: connects a robot's ROS graph to the engine, by one config file."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import signal
import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
import uvloop

from rce.aio.tasks import TaskScope
from rce.cli.options import Authority
from rce.config import ConfigError, ShippedFileError, examples_dir, start_logging
from rce.config.documents import read_file
from rce.own_process import escape_missing_letters, open_missing_streams
from rce.ros.errors import RosError
from rce.ros.names import parse_arguments
from rce.ros.packages import PackageIndex
from rce.ros.types import TypeRegistry
from rce.tls import CertificateError, Context, client_contexts
from rce_client.connection import Connection, State
from rce_client.exceptions import ClientError
from rce_client.reminder import Reminder
from rce_client.ros_bridge.bridge import build, joined_graph, wait_ready
from rce_client.ros_bridge.explain import dot, long_form, picture
from rce_client.ros_bridge.plan import Plan, make_plan
from rce_client.ros_bridge.robot_file import RobotFile
from rce_client.session import is_failure

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from rce.config.client import ClientConfig
    from rce.ros.node import Node

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)

BAD_CONFIG = 2
FAILED = 1
DEFAULT_MASTER = "http://localhost:11311/"


@app.command()
def bridge(
    config: Annotated[Path, typer.Argument(metavar="CONFIG", help="The robot's config file, JSON or YAML.")],
    check_only: Annotated[
        bool, typer.Option("--check", help="Check the file and print its content.")
    ] = False,
    ros_master_uri: Annotated[
        str, typer.Option(envvar="ROS_MASTER_URI", help="URI of the robot's ROS master.")
    ] = DEFAULT_MASTER,
    package_path: Annotated[
        list[Path] | None, typer.Option(help="Folder with packages of message types; may be repeated.")
    ] = None,
    explain: Annotated[
        bool, typer.Option("--explain", help="Print the long form of the file and its wiring.")
    ] = False,
    as_dot: Annotated[bool, typer.Option("--dot", help="Print the wiring for Graphviz.")] = False,
    authority: Authority = None,
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="Show more log messages.")] = False,
) -> None:
    """Connect a robot's ROS graph to the engine, until stopped."""
    start_logging(logging.DEBUG if verbose else logging.WARNING)
    types = TypeRegistry(_packages(package_path or ()))
    try:
        file = RobotFile(str(config), read_file(config), types)
        if check_only:
            print(summary(file.draft))  # noqa: T201
        elif explain or as_dot:
            read = uvloop.run(file.resolve(ros_master_uri, say))
            print(dot(read) if as_dot else f"{long_form(read)}\n{picture(read)}")  # noqa: T201
        else:
            tls = client_contexts(authority or file.draft.authority_file)
            uvloop.run(run(file, ros_master_uri, tls))
    except ConfigError as error:
        print(error, file=sys.stderr)  # noqa: T201
        raise typer.Exit(BAD_CONFIG) from error
    except (ClientError, RosError, CertificateError) as error:
        print(f"rce-ros: {error}", file=sys.stderr)  # noqa: T201
        raise typer.Exit(FAILED) from error


async def run(file: RobotFile, master_uri: str, tls: Context | None = None) -> None:
    """Bridge until SIGINT or SIGTERM, or until the robot's graph tells the node to stop.

    A second signal ends the program at once, without removing anything.

    Raises:
        ClientError: The engine refuses this robot.
        RosError: The robot's graph refuses the node.
        ConfigError: The type of a bridge cannot be read from the robot's graph.
    """
    task = asyncio.current_task()
    assert task is not None
    loop = asyncio.get_running_loop()
    stopping = False

    def on_signal(number: signal.Signals) -> None:
        nonlocal stopping
        stopping = True
        loop.remove_signal_handler(number)
        signal.signal(number, signal.SIG_DFL)
        task.cancel()

    def on_shutdown() -> None:
        nonlocal stopping
        if not stopping:
            stopping = True
            say("the robot's ROS graph told this program to stop")
            task.cancel()

    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, on_signal, number)
    try:
        await serve(file, master_uri, tls, on_shutdown)
    except asyncio.CancelledError:
        task.uncancel()


async def serve(
    file: RobotFile, master_uri: str, tls: Context | None, on_shutdown: Callable[[], None]
) -> None:
    """Bridge until cancelled or refused, then remove what was made.

    Args:
        file: The robot's file.
        master_uri: The robot's ROS master.
        tls: For ``https`` and ``wss``.
        on_shutdown: Called when the node is told to stop: by ``rosnode kill``, or because another node, such
            as a second ``rce-ros`` of this robot, took its name. The graph does not know it any more then.
    """
    async with (
        joined_graph(file.draft.robot, master_uri, file.types, say) as node,
        TaskScope() as watching,
    ):
        watching.spawn(_tell_shutdown(node, on_shutdown), name="until the node is told to stop")
        config = await file.complete(node, say)
        plan = make_plan(config)
        for tag in plan.unbridged:
            say(f"interface {tag} has no addr: it is not connected to the robot's ROS graph")
        async with _connection(config, tls) as conn:
            await _serve(config, plan, conn, node)


async def _tell_shutdown(node: Node, on_shutdown: Callable[[], None]) -> None:
    await node.until_shutdown()
    on_shutdown()


def _connection(config: ClientConfig, tls: Context | None) -> Connection:
    return Connection(
        config.url,
        config.user,
        config.password.get_secret_value(),
        config.robot,
        token=config.token.get_secret_value(),
        tls=tls,
        on_error=lambda text: say(f"engine: {text}"),
        on_state=partial(_tell_state, Reminder()),
    )


async def _serve(config: ClientConfig, plan: Plan, conn: Connection, node: Node) -> None:
    try:
        async with TaskScope() as tasks:
            await build(plan, conn, node, tasks)
            await wait_ready(plan, conn, say)
            print(f"rce-ros ready: robot {config.robot} connected", flush=True)  # noqa: T201
            await conn.wait_refused()
    except asyncio.CancelledError:
        current = asyncio.current_task()
        assert current is not None
        current.uncancel()  # told to stop: what follows must not be cancelled again
        await remove(conn)
    except (ClientError, RosError):
        await remove(conn)
        raise


async def remove(conn: Connection) -> None:
    """Remove what was created, if the engine is connected."""
    if conn.connected:
        say("removing what this program created")
        await conn.remove_all()
    else:
        say("the engine is not connected; what this program created there stays")


def summary(config: ClientConfig) -> str:
    """Return the content of a config file in words."""
    plan = make_plan(config)
    lines = [f"{config.robot} of user {config.user} at {config.url}"]
    lines += [f"  container {item.tag}" for item in config.containers]
    lines += [
        f"  node {item.container}/{item.node.tag}: {item.node.pkg} {item.node.exe} {item.node.args}".rstrip()
        for item in config.nodes
    ]
    lines += [
        f"  parameter {item.container}: {item.parameter.name} = {item.parameter.value!r}"
        for item in config.parameters
    ]
    lines += [f"  {span}" for span in plan.spans]
    lines += [f"  connection {link.tag_a} - {link.tag_b}" for link in config.connections]
    lines += [f"  {bridge}: its type is read from the robot's graph" for bridge in config.untyped.values()]
    return "\n".join(lines)


def say(text: str) -> None:
    """Print a message for the user."""
    print(f"rce-ros: {text}", file=sys.stderr, flush=True)  # noqa: T201


def _tell_state(reminder: Reminder, state: State, words: str) -> None:
    failed = is_failure(state, words) and reminder.is_due(words)
    if failed or state in (State.LOST, State.RESTORED):
        say(f"{state.value}: {words}")


def _packages(given: Iterable[Path]) -> PackageIndex:
    """Return the packages on the given path, then on the environment's, then those that are shipped."""
    path = [*given, *PackageIndex.from_environ().path]
    with contextlib.suppress(ShippedFileError):
        path.append(examples_dir())
    return PackageIndex(path)


def main() -> None:
    """Run the program."""
    open_missing_streams()
    escape_missing_letters()
    app()


def node() -> None:
    """Run the program as a node of a launch file; its name and remappings have no effect."""
    sys.argv[1:] = parse_arguments(sys.argv[1:]).rest
    main()


if __name__ == "__main__":
    main()
