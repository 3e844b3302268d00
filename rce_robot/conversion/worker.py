"""A process that converts large messages: ``python -m rce_robot.conversion.worker FD MEGABYTES PACKAGES``.

It reads jobs from a socket and answers them one after the other, until the socket is closed. It has a lower
priority than the process that started it, and the kernel kills it first when memory is short.
"""

from __future__ import annotations

import contextlib
import gc
import os
import resource
import socket
import struct
import sys
from pathlib import Path
from typing import TYPE_CHECKING, assert_never

import msgspec

from rce.buffers import unfilled
from rce.link import InterfaceError
from rce.model import InterfaceSpec, InterfaceType
from rce.protocol import Address, ProtocolError
from rce.protocol.large import read_large
from rce.ros.packages import PackageIndex
from rce.ros.tcpros.allocator import give_back_free_memory
from rce.ros.types import TypeRegistry
from rce_robot.conversion.jobs import HEAD, Job, ReadText, ReadValue, Result, Show, decode_job, pack
from rce_robot.exceptions import UnreadableError
from rce_robot.factory import FormFactory
from rce_robot.outgoing import Buffer, Outgoing

if TYPE_CHECKING:
    from rce_robot.forms import Form

MAX_TEXT = 64 << 20
"""Longest text that is sent to a robot, in bytes; clients do not accept longer ones."""
_NICE = 10
_MAX_WARNINGS = 256


class Worker:
    """Does jobs.

    Args:
        factory: Makes the forms of interfaces.
        memory: Bytes that the process may use, for error texts.
    """

    def __init__(self, factory: FormFactory, memory: int) -> None:
        self._factory = factory
        self._memory = memory

    def do(self, job: Job, parts: list[bytes]) -> tuple[Result, list[Buffer]]:
        """Do a job; the result holds faults of the message."""
        try:
            match job:
                case ReadText():
                    return self._read_text(job, parts)
                case ReadValue():
                    return self._read(job, msgspec.msgpack.decode(parts[0]), "")
                case Show():
                    return self._show(job, parts[0])
                case _:
                    assert_never(job)
        except (UnreadableError, ProtocolError, InterfaceError) as error:
            return Result(fault=str(error)), []
        except MemoryError:
            limit = self._memory >> 20
            return Result(fault=f"converting the message takes more than {limit} MiB of memory"), []

    def _read_text(self, job: ReadText, parts: list[bytes]) -> tuple[Result, list[Buffer]]:
        binaries = dict(zip(job.ids, parts[1:], strict=True))
        message = read_large(parts[0], binaries, Address(job.i_tag, job.stated_type))
        if isinstance(message, list):
            return Result(ids=tuple(message)), []
        if message.message_type != job.message_type:
            raise UnreadableError(f"carries {job.message_type}, not {message.message_type}")
        if isinstance(message.msg, str):
            return Result(text=message.msg[:4096], msg_id=message.msg_id), []
        return self._read(job, message.msg, message.msg_id)

    def _read(self, job: ReadText | ReadValue, msg: object, msg_id: str) -> tuple[Result, list[Buffer]]:
        warnings: list[str] = []
        try:
            payload = self._forms(job)[0].read(msg, warnings.append)
        except UnreadableError as error:
            return Result(fault=str(error), msg_id=msg_id), []
        return Result(warnings=tuple(warnings[:_MAX_WARNINGS]), msg_id=msg_id), [payload]

    def _show(self, job: Show, payload: bytes) -> tuple[Result, list[Buffer]]:
        form = self._forms(job)[1]
        outgoing = form.pack(job.i_tag, job.message_type, job.msg_id, form.show(payload))
        assert isinstance(outgoing, Outgoing)  # a Forwarder's payload is never heavy
        if len(outgoing.text) > MAX_TEXT:
            size = len(outgoing.text) >> 20
            raise UnreadableError(
                f"the message is {size} MiB long as JSON, over the limit of {MAX_TEXT >> 20} MiB; "
                "use a Forwarder for it"
            )
        return Result(), [outgoing.text, *(b"".join(parts) for parts in outgoing.binaries)]

    def _forms(self, job: Job) -> tuple[Form, Form]:
        type_ = InterfaceType.parse(job.interface_type)
        return self._factory.pair(
            InterfaceSpec(tag="", type=job.interface_type, message_type=job.message_type), type_
        )


def serve(sock: socket.socket, worker: Worker) -> None:
    """Do jobs until the socket ends."""
    while (head := _receive(sock, HEAD.size)) is not None:
        (count,) = HEAD.unpack(head)
        sizes = struct.unpack(f"!{count}Q", _need(sock, 8 * count))
        meta, *parts = (_need(sock, size) for size in sizes)
        job = decode_job(meta)
        del meta
        result, answer = worker.do(job, parts)
        del parts
        packet = pack(result, answer)
        del answer
        for buffer in packet:
            sock.sendall(buffer)
        del packet, buffer
        gc.collect()  # an error's traceback holds a reference cycle
        give_back_free_memory()


def _need(sock: socket.socket, size: int) -> bytes:
    data = _receive(sock, size)
    if data is None:
        raise EOFError("the socket ended within a job")
    return data


def _receive(sock: socket.socket, size: int) -> bytes | None:
    """Read a number of bytes; return None if the socket is closed before the first."""
    if not size:
        return b""
    memory = unfilled(size)
    filled = 0
    with memory.getbuffer() as view:
        while filled < size:
            count = sock.recv_into(view[filled:])
            if count == 0:
                if filled == 0:
                    return None
                raise EOFError("the socket ended within a job")
            filled += count
    return memory.getvalue()


def _give_way(memory: int) -> None:
    """Limit the memory of this process, lower its priority, and let the kernel kill it first."""
    resource.setrlimit(resource.RLIMIT_DATA, (memory, memory))
    os.nice(_NICE)
    with contextlib.suppress(OSError):  # not permitted on this system; the limit of memory still holds
        Path("/proc/self/oom_score_adj").write_text("800")
    gc.disable()  # a message is a tree; a search for cycles takes longer than parsing it


def main() -> None:
    """Serve the socket that was passed on."""
    fd, megabytes, *packages = sys.argv[1:]
    memory = int(megabytes) << 20
    _give_way(memory)
    types = TypeRegistry(PackageIndex([Path(package) for package in packages]))
    with socket.socket(fileno=int(fd)) as sock:
        gc.freeze()
        sock.sendall(b"\0")
        with contextlib.suppress(EOFError, ConnectionError):  # the endpoint has ended
            serve(sock, Worker(FormFactory(types), memory))


if __name__ == "__main__":
    main()
