"""``python -m rce_container.nursery PADDING``: forks environments on the orders of one manager.

Its standard input is a socket for the orders; it ends when the other end is closed. It has one thread and no
event loop, and knows no secret: all that it ever held is in every environment's memory.
"""

from __future__ import annotations

import array
import contextlib
import gc
import importlib
import itertools
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Sequence

import msgspec

from rce.supervision.title import set_title, show_variables
from rce_container.environment.messages import Boot
from rce_container.environment.nodes.cradle import Cradle
from rce_container.environment.process import OF_ENVIRONMENT, die_before_others, limit_oneself
from rce_container.environment.running import run_environment
from rce_container.nursery import kernel
from rce_container.nursery.confine import confine
from rce_container.nursery.cradle import rock
from rce_container.nursery.messages import (
    FAREWELL,
    MAX_PACKET,
    Answer,
    Birth,
    Gifts,
    decode_birth,
    encode,
)
from rce_container.nursery.mounts import HOME

for _module in ("encodings.idna", "importlib.metadata", "uvloop", "yaml", "xml.etree.ElementTree"):
    with contextlib.suppress(ImportError):  # what environments and nodes would import when they need it
        importlib.import_module(_module)

_GIFTS = len(Gifts._fields)


def main() -> None:
    """Serve a manager; in a forked child, be what was ordered."""
    die_before_others(OF_ENVIRONMENT)
    set_title((sys.executable, "-m", "rce_container.nursery"), "rce-nursery")
    orders = socket.socket(fileno=os.dup(0))
    program = orders.recv(MAX_PACKET)
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)
    kernel.take_in_orphans()
    gc.collect()
    gc.freeze()  # no collection touches, and so copies, what the children share
    found = _wait(orders)
    if found is not None:
        orders.close()
        _live(*found, program)


def _wait(orders: socket.socket) -> tuple[Birth, Gifts] | None:
    """Fork a child for each order. Returns in the children, and with nothing when the manager is gone."""
    packet = bytearray(MAX_PACKET)
    while True:
        size, fds = _receive(orders, packet)
        if not size:
            return None
        child = os.fork() if len(fds) == _GIFTS else -1
        if child == 0:
            return decode_birth(memoryview(packet)[:size]), Gifts(*fds)
        packet[:size] = bytes(size)  # the next container shall not find who came before
        for fd in fds:
            os.close(fd)


def _receive(orders: socket.socket, packet: bytearray) -> tuple[int, array.array[int]]:
    """Wait for an order; returns its size and its descriptors."""
    fds = array.array("i")
    room = socket.CMSG_SPACE(_GIFTS * fds.itemsize)
    size, ancillary, _, _ = orders.recvmsg_into((packet,), room)
    for level, kind, data in ancillary:
        if (level, kind) == (socket.SOL_SOCKET, socket.SCM_RIGHTS):
            fds.frombytes(data[: len(data) - len(data) % fds.itemsize])
    return size, fds


def _live(birth: Birth, gifts: Gifts, program: bytes) -> None:
    """Become the environment of a container."""
    answer = socket.socket(fileno=gifts.answer)
    try:
        set_title((sys.executable, "-m", "rce_container.environment", birth.boot.id), "rce-environment")
        logs = confine(birth, gifts, program)
        boot = _settle(birth, gifts, logs)
        _check(birth.check)
    except Exception as error:  # noqa: BLE001 - whatever it is, the manager is told
        answer.send(encode(Answer(error=f"{type(error).__name__}: {error}")))
        os._exit(1)
    cradle = _fork_cradle(answer)
    if cradle is None:
        return
    answer.send(encode(Answer()))
    answer.close()
    control, links = socket.socket(fileno=gifts.control), socket.socket(fileno=gifts.links)
    run_environment(boot, control, links, Cradle(cradle))
    with contextlib.suppress(OSError):
        os.write(gifts.tether, FAREWELL)


def _fork_cradle(answer: socket.socket) -> socket.socket | None:
    """Fork the cradle, while nothing is known that nodes must not know.

    Returns:
        In the environment its end of a socket that leads to the cradle; None in the cradle, and in each node
        that it forked, when they are to end.
    """
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    if os.fork():
        theirs.close()
        return ours
    ours.close()
    answer.detach()  # closed with all others, and its number may be taken by a node later
    _close_all_but({0, 1, 2, theirs.fileno()})
    set_title((sys.executable, "-m", "rce_container.nursery.cradle"), "rce-cradle")
    rock(theirs)
    return None


def _settle(birth: Birth, gifts: Gifts, logs: int) -> Boot:
    """Arrange descriptors, variables and signals as a new program finds them."""
    nothing = os.open(os.devnull, os.O_RDWR)
    for fd, number in ((nothing, 0), (gifts.log, 1), (gifts.log, 2)):
        os.dup2(fd, number)
    kept = (gifts.answer, gifts.tether, gifts.control, gifts.links, logs)
    _close_all_but({0, 1, 2, *kept})
    for fd in kept:
        os.set_inheritable(fd, False)
    os.environ.clear()
    os.environ.update(birth.environ)
    show_variables(birth.environ)
    os.chdir(HOME)
    limit_oneself(birth.boot.rlimits)
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    return msgspec.structs.replace(birth.boot, home=HOME, logs=f"/proc/self/fd/{logs}")


def _check(command: Sequence[str]) -> None:
    if command:
        done = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603
        if done.returncode:
            words = done.stderr.strip().splitlines()
            raise ChildProcessError(words[-1] if words else f"{command[0]} ended with {done.returncode}")


def _close_all_but(kept: set[int]) -> None:
    edges = sorted(kept)
    for low, high in itertools.pairwise(edges):
        os.closerange(low + 1, high)
    os.closerange(edges[-1] + 1, os.sysconf("SC_OPEN_MAX"))


main()
