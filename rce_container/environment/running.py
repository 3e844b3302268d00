"""Runs an environment in this process, from its log to its event loop."""

from __future__ import annotations

import asyncio
import logging
import signal
import socket
from pathlib import Path

from rce_container.environment.environment import Environment
from rce_container.environment.logs.files import ENVIRONMENT_LOG, LogWriter
from rce_container.environment.messages import Boot
from rce_container.environment.nodes.cradle import Cradle
from rce_container.environment.process import limit_oneself


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
    boot: Boot, control: socket.socket, links: socket.socket, cradle: Cradle | None = None
) -> None:
    """Live as a container's environment; returns when the container has ended properly.

    Args:
        boot: What the manager says of the container.
        control: A listening unix socket for managers.
        links: A listening unix socket for peers' links.
        cradle: See :class:`Environment`.
    """
    limit_oneself(boot.rlimits)
    writer = LogWriter(Path(boot.logs), ENVIRONMENT_LOG, mirror=(1, 2))
    logging.basicConfig(level=logging.INFO, handlers=[_Handler(writer)])
    try:
        import uvloop
    except ImportError:
        asyncio.run(_live(boot, control, links, cradle))
    else:
        uvloop.run(_live(boot, control, links, cradle))


async def _live(boot: Boot, control: socket.socket, links: socket.socket, cradle: Cradle | None) -> None:
    loop = asyncio.get_running_loop()
    environment = Environment(boot, control, links, cradle)
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, environment.end, number.name)
    await environment.run()
