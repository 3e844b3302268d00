"""``python -m rce_container.forkserver PADDING``: forks environments on the orders of one manager.

Its standard input is a socket for the orders; it ends when the other end is closed. It has one thread and no
event loop. It holds no secret, because every environment inherits its memory: also what it found on the
machine's package path, ``RCE_PACKAGE_PATH``.
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
import time
from collections.abc import Sequence

import msgspec

from rce.ros.packages import PackageIndex
from rce.supervision.title import set_title, show_variables
from rce_container.environment.messages import Boot
from rce_container.environment.nodes.fork_server import NodeForkServer
from rce_container.environment.process import OF_ENVIRONMENT, set_oom_score, set_rlimits
from rce_container.environment.running import run_environment
from rce_container.forkserver import kernel
from rce_container.forkserver.confine import confine
from rce_container.forkserver.messages import (
    FAREWELL,
    MAX_PACKET,
    Answer,
    Descriptors,
    SpawnRequest,
    decode_request,
    encode,
)
from rce_container.forkserver.mounts import HOME
from rce_container.forkserver.nodes import serve

for _module in ("encodings.idna", "importlib.metadata", "uvloop", "yaml", "xml.etree.ElementTree"):
    with contextlib.suppress(ImportError):  # modules that environments and nodes would import later
        importlib.import_module(_module)

_DESCRIPTORS = len(Descriptors._fields)
_LOOK_SHARE = 100
"""Packages are looked for in a hundredth of the time at most: orders wait meanwhile."""


def main() -> None:
    """Serve a manager; in a forked child, run the ordered process."""
    set_oom_score(OF_ENVIRONMENT)
    set_title((sys.executable, "-m", "rce_container.forkserver"), "rce-fork server")
    orders = socket.socket(fileno=os.dup(0))
    program = orders.recv(MAX_PACKET)
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)
    kernel.become_subreaper()
    gc.collect()
    gc.freeze()  # no garbage collection touches, and so copies, the pages that the children share
    packages = PackageIndex.from_environ()
    found = _wait(orders, packages)
    if found is not None:
        orders.close()
        packages.expire()  # the container's user may not see all of it
        _live(*found, program)


def _wait(orders: socket.socket, packages: PackageIndex) -> tuple[SpawnRequest, Descriptors] | None:
    """Fork a child for each order.

    Return in the children, and with None when the manager has disconnected.
    """
    packet = bytearray(MAX_PACKET)
    due = 0.0
    while True:
        size, fds = _receive(orders, packet)
        if not size:
            return None
        child = os.fork() if len(fds) == _DESCRIPTORS else -1
        if child == 0:
            return decode_request(memoryview(packet)[:size]), Descriptors(*fds)
        packet[:size] = bytes(size)  # the next container must not find the data of the one before
        for fd in fds:
            os.close(fd)
        if time.monotonic() >= due:  # after an order, which does not wait; later environments inherit it
            began = time.process_time()
            packages.look()
            gc.freeze()
            due = time.monotonic() + _LOOK_SHARE * (time.process_time() - began)


def _receive(orders: socket.socket, packet: bytearray) -> tuple[int, array.array[int]]:
    """Wait for an order; returns its size and its descriptors."""
    fds = array.array("i")
    room = socket.CMSG_SPACE(_DESCRIPTORS * fds.itemsize)
    size, ancillary, _, _ = orders.recvmsg_into((packet,), room)
    for level, kind, data in ancillary:
        if (level, kind) == (socket.SOL_SOCKET, socket.SCM_RIGHTS):
            fds.frombytes(data[: len(data) - len(data) % fds.itemsize])
    return size, fds


def _live(request: SpawnRequest, descriptors: Descriptors, program: bytes) -> None:
    """Become the environment of a container."""
    answer = socket.socket(fileno=descriptors.answer)
    try:
        set_title((sys.executable, "-m", "rce_container.environment", request.boot.id), "rce-environment")
        logs = confine(request, descriptors, program)
        boot = _settle(request, descriptors, logs)
        _check(request.check)
    except Exception as error:  # noqa: BLE001 - every error is reported to the manager
        answer.send(encode(Answer(error=f"{type(error).__name__}: {error}")))
        os._exit(1)
    node_server = _fork_node_server(answer)
    if node_server is None:
        return
    answer.send(encode(Answer()))
    answer.close()
    control, links = socket.socket(fileno=descriptors.control), socket.socket(fileno=descriptors.links)
    run_environment(boot, control, links, NodeForkServer(node_server))
    with contextlib.suppress(OSError):
        os.write(descriptors.lifeline, FAREWELL)


def _fork_node_server(answer: socket.socket) -> socket.socket | None:
    """Fork the node fork server, before this process knows anything that nodes must not know.

    Returns:
        In the environment its end of a socket that leads to the node fork server; None in that server, and in
        each node that it forked, when they are to end.
    """
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    if os.fork():
        theirs.close()
        return ours
    ours.close()
    answer.detach()  # closed with all others, and its number may be taken by a node later
    _close_all_but({0, 1, 2, theirs.fileno()})
    set_title((sys.executable, "-m", "rce_container.forkserver.nodes"), "rce-node-server")
    serve(theirs)
    return None


def _settle(request: SpawnRequest, descriptors: Descriptors, logs: int) -> Boot:
    """Set descriptors, variables and signals as for a new program."""
    nothing = os.open(os.devnull, os.O_RDWR)
    for fd, number in ((nothing, 0), (descriptors.log, 1), (descriptors.log, 2)):
        os.dup2(fd, number)
    kept = (descriptors.answer, descriptors.lifeline, descriptors.control, descriptors.links, logs)
    _close_all_but({0, 1, 2, *kept})
    for fd in kept:
        os.set_inheritable(fd, False)
    os.environ.clear()
    os.environ.update(request.environ)
    show_variables(request.environ)
    os.chdir(HOME)
    set_rlimits(request.boot.rlimits)
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    return msgspec.structs.replace(request.boot, home=HOME, logs=f"/proc/self/fd/{logs}")


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
