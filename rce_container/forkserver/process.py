"""The manager's side of the fork server: starts it, restarts it after its end, and gives it orders."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import socket
import struct
import subprocess
import sys
from collections.abc import Mapping

import msgspec

from rce.supervision.title import ROOM_VARIABLE, padding
from rce_container.exceptions import StartError
from rce_container.forkserver.messages import (
    MAX_PACKET,
    Answer,
    Descriptors,
    SpawnRequest,
    decode_answer,
    encode,
)

_log = logging.getLogger(__name__)

_ATTEMPTS = 3
_CREDENTIALS = struct.Struct("iII")
_CLOSE_TIMEOUT_S = 5.0


class ForkServer:
    """Makes environments. Used by one event loop; :meth:`close` ends it.

    Args:
        program: The filter of system calls for all environments; empty for none.
        environ: The environment variables of the fork server, which hold no secret.
    """

    def __init__(self, program: bytes, environ: Mapping[str, str]) -> None:
        self._program = program
        self._environ = {**environ, ROOM_VARIABLE: padding()}
        self._process: subprocess.Popen[bytes] | None = None
        self._orders: socket.socket | None = None

    @property
    def pid(self) -> int:
        """The current process of the fork server; 0 while none runs."""
        return self._process.pid if self._process is not None else 0

    async def spawn(self, request: SpawnRequest, descriptors: Descriptors) -> int:
        """Make an environment; returns its pid.

        Args:
            request: The environment.
            descriptors: Its descriptors; :attr:`Descriptors.answer` is filled in here.

        Raises:
            StartError: It cannot be made. Its images may be mounted in the namespaces, which must end then.
        """
        for _ in range(_ATTEMPTS):
            ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
            with ours, theirs:
                ours.setsockopt(socket.SOL_SOCKET, socket.SO_PASSCRED, 1)
                self._order(request, descriptors._replace(answer=theirs.fileno()))
                theirs.close()
                answer, pid = await _receive_answer(ours)
            if answer is None and any(volume.image for volume in request.volumes):
                # They may be mounted there already; a second mount would damage them.
                raise StartError("its environment died as it was made")
            if answer is None:
                _log.warning("a container's environment died as it was made; it is tried again")
                continue
            if answer.error:
                raise StartError(f"its environment cannot be confined: {answer.error}")
            return pid
        raise StartError(
            "its environment, or the fork server that makes it, ends each time; this program's log says why"
        )

    def start(self) -> None:
        """Start the process if it does not run, to be ready for the first order. Does not wait for it.

        Raises:
            StartError: It cannot be started.
        """
        if self._process is not None and self._process.poll() is None:
            return
        self.close()
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            try:
                self._process = subprocess.Popen(  # noqa: S603
                    [sys.executable, "-P", "-m", "rce_container.forkserver", padding()],
                    stdin=theirs.fileno(),
                    stdout=subprocess.DEVNULL,
                    env=self._environ,
                    start_new_session=True,
                )
            except OSError as error:
                ours.close()
                raise StartError(f"cannot start {sys.executable}: {error}") from error
        ours.setblocking(False)
        ours.send(self._program)
        self._orders = ours

    def close(self) -> None:
        """End the process. The environments that it made live on."""
        if self._orders is not None:
            self._orders.close()
            self._orders = None
        if self._process is not None:
            try:
                self._process.wait(_CLOSE_TIMEOUT_S)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
            self._process = None

    def _order(self, request: SpawnRequest, descriptors: Descriptors) -> None:
        packet = encode(request)
        if len(packet) > MAX_PACKET:
            raise StartError(f"what is to be told of it takes {len(packet)} bytes; {MAX_PACKET} are allowed")
        for _ in range(_ATTEMPTS):
            self.start()
            assert self._orders is not None
            try:
                socket.send_fds(self._orders, [packet], descriptors)
            except (BrokenPipeError, ConnectionResetError):
                self.close()
            except OSError as error:
                raise StartError(f"the fork server of environments takes no order: {error}") from error
            else:
                return
        raise StartError("the fork server of environments dies at once; its reason is in this program's log")


async def receive_credentials(sock: socket.socket, size: int) -> tuple[bytes, int]:
    """Wait for data on a socket with ``SO_PASSCRED``; return it and its sender's pid, as seen from here.

    At the end of the stream both are empty.
    """
    loop = asyncio.get_running_loop()
    sock.setblocking(False)
    while True:
        try:
            data, ancillary, _, _ = sock.recvmsg(size, socket.CMSG_SPACE(_CREDENTIALS.size))
        except (BlockingIOError, InterruptedError):
            await _readable(loop, sock)
            continue
        except ConnectionResetError:
            return b"", 0
        if not data:
            return b"", 0
        for level, kind, value in ancillary:
            if (level, kind) == (socket.SOL_SOCKET, socket.SCM_CREDENTIALS):
                return data, _CREDENTIALS.unpack(value)[0]
        return data, 0


async def _receive_answer(sock: socket.socket) -> tuple[Answer | None, int]:
    data, pid = await receive_credentials(sock, MAX_PACKET)
    if not data:
        return None, 0
    with contextlib.suppress(msgspec.DecodeError):
        return decode_answer(data), pid
    return None, 0


async def _readable(loop: asyncio.AbstractEventLoop, sock: socket.socket) -> None:
    ready = loop.create_future()
    loop.add_reader(sock, _wake, ready)
    try:
        await ready
    finally:
        loop.remove_reader(sock)


def _wake(ready: asyncio.Future[None]) -> None:
    if not ready.done():
        ready.set_result(None)
