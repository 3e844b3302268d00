"""The environment's side of the node fork server (:mod:`rce_container.forkserver.nodes`)."""

from __future__ import annotations

import logging
import os
import socket
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from rce_container.forkserver.nodes import Script, encode_script

_log = logging.getLogger(__name__)

_TIMEOUT_S = 5.0
_MAX_ANSWER = 32
_HANDLED = "PYTHONUNBUFFERED"


class NodeForkServer:
    """Starts Python scripts without starting a Python interpreter.

    Args:
        sock: Connects to the node fork server.
    """

    def __init__(self, sock: socket.socket) -> None:
        sock.settimeout(_TIMEOUT_S)
        self._sock: socket.socket | None = sock

    def spawn(
        self, argv: Sequence[str], *, env: Mapping[str, str], cwd: str, stdout: int, stderr: int
    ) -> int:
        """Start a process, a child of this one, if it is a script for this very Python. Blocks briefly.

        Returns:
            Its pid; 0 if the node has to be started in the ordinary way.
        """
        if self._sock is None or not fits(argv, env, os.environ):
            return 0
        packet = encode_script(Script(path=argv[1], arguments=tuple(argv[2:]), environ=dict(env), folder=cwd))
        try:
            socket.send_fds(self._sock, [packet], (stdout, stderr))
            answer = self._sock.recv(_MAX_ANSWER)
        except OSError as error:
            _log.warning(
                "nodes start more slowly from now on: the node fork server does not answer: %s", error
            )
            answer = _last_answer(self._sock)
            self.close()
        if not answer:
            self.close()
            return 0
        return int(answer)

    def close(self) -> None:
        """End the node fork server."""
        if self._sock is not None:
            self._sock.close()
            self._sock = None


def _last_answer(sock: socket.socket) -> bytes:
    """Refuse all answers from now on; return one that has come before, since its process runs."""
    try:
        sock.setblocking(False)
        sock.shutdown(socket.SHUT_RD)
        return sock.recv(_MAX_ANSWER)
    except OSError:
        return b""


def fits(argv: Sequence[str], env: Mapping[str, str], own: Mapping[str, str]) -> bool:
    """Whether a command is a script for this Python, with the same variables that shape an interpreter."""
    return (
        len(argv) > 1
        and argv[0] == sys.executable
        and argv[1].endswith(".py")
        and _shaping(env) == _shaping(own)
        and not _hides_a_module(Path(argv[1]).resolve().parent)
    )


def _hides_a_module(folder: Path) -> bool:
    """Whether a script in this folder would import a module from there that is loaded here from elsewhere."""
    try:
        names = {path.name.partition(".")[0] for path in folder.iterdir()}
    except OSError:
        return True
    return not names.isdisjoint(sys.modules)


def _shaping(env: Mapping[str, str]) -> dict[str, str]:
    """Return the variables that Python and the dynamic linker read when a program starts."""
    return {
        name: value
        for name, value in env.items()
        if name.startswith(("PYTHON", "LD_", "MALLOC_", "GLIBC_")) and name != _HANDLED
    }
