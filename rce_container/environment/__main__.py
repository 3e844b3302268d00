"""``python -m rce_container.environment BOOT``: the first process of a container."""

from __future__ import annotations

import asyncio
import logging
import os
import signal
import socket
import sys
from pathlib import Path

from rce_container.environment.environment import Environment
from rce_container.environment.logs import ENVIRONMENT_LOG, LogWriter
from rce_container.environment.messages import Boot, decode_boot
from rce_container.environment.process import keep_to_oneself, take_in_orphans


class _Handler(logging.Handler):
    """Writes log records to the environment's own log."""

    def __init__(self, writer: LogWriter) -> None:
        super().__init__()
        self._writer = writer
        self.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))

    def emit(self, record: logging.LogRecord) -> None:
        """Write one record."""
        self._writer.write(self.format(record).encode(errors="replace") + b"\n")


async def _live(boot: Boot, control: socket.socket, links: socket.socket) -> None:
    loop = asyncio.get_running_loop()
    environment = Environment(boot, control, links)
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, environment.end, number.name)
    await environment.run()


def main() -> None:
    """Run the environment that the first argument describes."""
    boot = decode_boot(sys.argv[1])
    control, links = (socket.socket(fileno=os.dup(fd)) for fd in (0, 1))
    with open(os.devnull, "rb") as nothing:  # noqa: PTH123
        os.dup2(nothing.fileno(), 0)
    writer = LogWriter(Path(boot.logs), ENVIRONMENT_LOG, mirror=(1, 2))
    logging.basicConfig(level=logging.INFO, handlers=[_Handler(writer)])
    if boot.isolated:
        keep_to_oneself()
    else:
        take_in_orphans()
    try:
        import uvloop
    except ImportError:
        asyncio.run(_live(boot, control, links))
    else:
        uvloop.run(_live(boot, control, links))


main()
