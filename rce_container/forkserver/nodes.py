"""The node fork server: a confined child of the environment that forks nodes which are Python scripts.

It is forked before the environment knows any data, holds only its socket, and has imported the modules that
nodes of the engine need: such a node starts without a new interpreter and without imports.
"""

from __future__ import annotations

import os
import signal
import socket
import sys
import time

import msgspec
from msgspec import Struct

from rce.supervision.title import set_title, show_variables
from rce_container.environment.process import OF_NODES, set_oom_score
from rce_container.forkserver import kernel
from rce_container.forkserver.script import open_streams, run_script

MAX_PACKET = 1 << 18
"""Bytes."""
STREAMS = 2
"""Descriptors that come with a script: its standard output and error."""

_PAUSE_S = 0.0002


class Script(Struct, frozen=True, kw_only=True):
    """A request to start a node. Answered by its pid, just before it begins."""

    path: str
    arguments: tuple[str, ...]
    environ: dict[str, str]
    folder: str


encode_script = msgspec.json.Encoder().encode
decode_script = msgspec.json.Decoder(Script).decode


def serve(orders: socket.socket) -> None:
    """Fork a node for each order. Return in each node when it ends, else when the environment has ended."""
    while True:
        packet, fds, _, _ = socket.recv_fds(orders, MAX_PACKET, STREAMS)
        if not packet:
            return
        between = os.fork()
        if between == 0:
            _leave_to_environment(orders)
            orders.close()
            _be(decode_script(packet), fds)
            return
        for fd in fds:
            os.close(fd)
        os.waitpid(between, 0)


def _leave_to_environment(orders: socket.socket) -> None:
    """Continue as a child whose parent ends at once: the environment adopts orphans, and gets its pid.

    Ends if the environment does not wait for it any more, since it starts the node in the ordinary way then.
    """
    between = os.getpid()
    if os.fork():
        os._exit(0)
    while os.getppid() == between:  # a node may ask to end with its parent
        time.sleep(_PAUSE_S)
    try:
        orders.send(b"%d" % os.getpid())
    except OSError:
        os._exit(1)


def _be(script: Script, fds: list[int]) -> None:
    os.setsid()
    for number, fd in enumerate(fds, 1):
        os.dup2(fd, number)
        os.close(fd)
    os.environ.clear()
    os.environ.update(script.environ)
    show_variables(script.environ)
    set_title((sys.executable, script.path, *script.arguments), os.path.basename(sys.executable))  # noqa: PTH119
    kernel.set_dumpable(True)
    set_oom_score(OF_NODES)
    os.chdir(script.folder)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    open_streams(unbuffered=bool(script.environ.get("PYTHONUNBUFFERED")))
    run_script(script.path, script.arguments)
