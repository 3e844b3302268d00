"""Runs an environment in this process, from its log to its event loop."""

from __future__ import annotations

import asyncio
import logging
import signal
import socket
from pathlib import Path

from rce.own_process import collect_all_seldom
from rce_container.environment.environment import Environment
from rce_container.environment.logs.files import ENVIRONMENT_LOG, LogWriter
from rce_container.environment.messages import Boot
from rce_container.environment.nodes.fork_server import NodeForkServer
from rce_container.environment.process import set_rlimits


class _Handler(logging.Handler):
    """Writes log records to the environment's own log."""

    def __init__(self, writer: LogWriter) -> None:
        super().__init__()
        self._writer = writer
        self.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))

    def emit(self, record: logging.LogRecord) -> None:
        """Write one record."""
        self._writer.write(self.format(record).encode(errors="replace") + b"\n")


def run_environment(
    boot: Boot, control: socket.socket, links: socket.socket, node_server: NodeForkServer | None = None
) -> None:
    """Live as a container's environment; returns when the container has ended properly.

    Args:
        boot: What the manager says of the container.
        control: A listening unix socket for managers.
        links: A listening unix socket for peers' links.
        node_server: See :class:`Environment`.
    """
    set_rlimits(boot.rlimits)
    collect_all_seldom()
    writer = LogWriter(Path(boot.logs), ENVIRONMENT_LOG, mirror=(1, 2))
    logging.basicConfig(level=logging.INFO, handlers=[_Handler(writer)])
    try:
        import uvloop
    except ImportError:
        asyncio.run(_live(boot, control, links, node_server))
    else:
        uvloop.run(_live(boot, control, links, node_server))


async def _live(
    boot: Boot, control: socket.socket, links: socket.socket, node_server: NodeForkServer | None
) -> None:
    loop = asyncio.get_running_loop()
    environment = Environment(boot, control, links, node_server)
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, environment.end, number.name)
    await environment.run()
