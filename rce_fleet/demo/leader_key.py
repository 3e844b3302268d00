"""Kills the leading master of a demo: by a key on the terminal, or a button on the page."""

from __future__ import annotations

import asyncio
import errno
import os
import sys
import termios
import tty
from contextlib import contextmanager
from typing import TYPE_CHECKING

from rce_fleet.demo.exceptions import DemoError
from rce_fleet.demo.masters import kill_leader
from rce_fleet.station.masters_watch import KILL_SIGNAL

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

KEY = "k"


@contextmanager
def leader_key(urls: Sequence[str], say: Callable[[str], None]) -> Iterator[None]:
    """Kill the leading master for each key and each signal, until the block is left.

    Args:
        urls: The masters.
        say: Prints a line for the user.
    """
    loop = asyncio.get_running_loop()
    running: set[asyncio.Task[None]] = set()

    def kill() -> None:
        if not running:
            task = loop.create_task(_kill(urls, say))
            running.add(task)
            task.add_done_callback(running.discard)

    loop.add_signal_handler(KILL_SIGNAL, kill)
    try:
        with _keys(loop, kill):
            yield
    finally:
        loop.remove_signal_handler(KILL_SIGNAL)
        for task in running:
            task.cancel()


async def _kill(urls: Sequence[str], say: Callable[[str], None]) -> None:
    try:
        leader = await kill_leader(urls)
    except DemoError as error:
        say(str(error))
    else:
        say(f"killed the leading master {leader.url}, term {leader.term}")


@contextmanager
def _keys(loop: asyncio.AbstractEventLoop, kill: Callable[[], None]) -> Iterator[None]:
    """Read keys one by one, if there is a terminal and it is this program's now."""
    if sys.stdin is None or not sys.stdin.isatty() or not _is_ours(file := sys.stdin.fileno()):
        yield
        return
    before = termios.tcgetattr(file)

    def read() -> None:
        try:
            text = os.read(file, 64)
        except OSError:  # the terminal is gone
            text = b""
        if not text:
            loop.remove_reader(file)
        elif KEY.encode() in text.lower():
            kill()

    tty.setcbreak(file)
    loop.add_reader(file, read)
    try:
        yield
    finally:
        loop.remove_reader(file)
        if _is_ours(file):
            termios.tcsetattr(file, termios.TCSADRAIN, before)


def _is_ours(terminal: int) -> bool:
    """Return whether this program is in the foreground: in the background a change of modes would stop it."""
    try:
        return os.tcgetpgrp(terminal) == os.getpgrp()
    except OSError as error:
        return error.errno == errno.ENOTTY  # that of another session stops no program; others are gone
