"""Takes all it can get of one thing, and says how much that was: ``starve.py THING``.

Prints ``has N`` as it goes: megabytes of memory, else pieces. ``{"ended": ...}`` says why it stopped.
"""

from __future__ import annotations

import asyncio
import contextlib
import ctypes
import errno
import json
import mmap
import os
import resource
import signal
import socket
import sys
import threading
import time
import xmlrpc.client
from collections.abc import Callable, Iterator
from functools import partial
from itertools import count, islice

from attempts import find_process, libc, system

MB = 1 << 20
ENOUGH_MB = 320
ENOUGH = 2000
PIECE = b"x" * MB
MAP_NORESERVE = 0x4000
_kept: list[object] = []


def anonymous() -> Iterator[int]:
    """Memory of a process."""
    for number in count(1):
        _kept.append(bytearray(PIECE))
        yield number


def files_in(folder: str) -> Callable[[], Iterator[int]]:
    """Files of a megabyte each."""

    def fill() -> Iterator[int]:
        for number in count(1):
            with open(f"{folder}/hog{number}", "wb", buffering=0) as file:
                if file.write(PIECE) < MB:
                    raise OSError(errno.ENOSPC, "the folder is full")
            yield number

    return fill


def empty_files() -> Iterator[int]:
    """Files with nothing in them; pieces."""
    for number in count(1):
        os.close(os.open(f"/tmp/empty{number}", os.O_CREAT | os.O_WRONLY))
        if number % 1000 == 0:
            yield number


def memfd() -> Iterator[int]:
    """Files without a name."""
    for number in count(1):
        fd = os.memfd_create("hog")
        os.write(fd, PIECE)
        yield number


def shared_segments() -> Iterator[int]:
    """Shared memory that nobody is attached to."""
    libc.shmat.restype = ctypes.c_void_p
    for number in count(1):
        segment = system("shmget", 0, MB, 0o1600)
        at = libc.shmat(segment, None, 0)
        ctypes.memset(at, 1, MB)
        libc.shmdt(ctypes.c_void_p(at))
        yield number


def pipes() -> Iterator[int]:
    """Pipes that nobody reads."""
    held = 0
    for _ in count():
        ours, theirs = os.pipe()
        os.set_blocking(theirs, False)
        held += _fill(partial(os.write, theirs, PIECE[:65536]))
        _kept.append(ours)
        yield held // MB


def unix_sockets() -> Iterator[int]:
    """Unix sockets that nobody reads."""
    held = 0
    for _ in count():
        pair = socket.socketpair()
        pair[0].setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 8 * MB)
        pair[0].setblocking(False)
        held += _fill(partial(pair[0].send, PIECE[:65536]))
        _kept.append(pair)
        yield held // MB


def tcp_sockets() -> Iterator[int]:
    """Connections that nobody reads."""
    held = 0
    with socket.create_server(("127.0.0.1", 0), backlog=100) as server:
        for _ in range(100):
            sender = socket.create_connection(server.getsockname())
            sender.setblocking(False)
            held += _fill(partial(sender.send, PIECE))
            _kept.append((sender, server.accept()))
            yield held // MB


def page_tables() -> Iterator[int]:
    """The kernel's notes on memory that is hardly used: a page of them for each two megabytes."""
    held = 0
    for _ in count():
        area = mmap.mmap(-1, 2 * MB * 256 * 8, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS | MAP_NORESERVE)
        area.madvise(mmap.MADV_NOHUGEPAGE)
        for at in range(0, len(area), 2 * MB):
            area[at]
        _kept.append(area)
        held += len(area) // (2 * MB) * 4096
        yield held // MB


def forks() -> Iterator[int]:
    """Children that fork too, each in a session of its own, deaf to signals, and stop themselves."""
    for number in count(1):
        if os.fork() == 0:
            os.setsid()
            for sign in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
                signal.signal(sign, signal.SIG_IGN)
            if os.fork():
                os.kill(os.getpid(), signal.SIGSTOP)
            while True:
                time.sleep(600)
        yield number


def zombies() -> Iterator[int]:
    """Children that are dead."""
    for number in count(1):
        if os.fork() == 0:
            os._exit(0)
        yield number


def waiting_parents() -> Iterator[int]:
    """Parents that no signal but SIGKILL reaches while their child lives (``vfork``)."""
    for number in count(1):
        if os.fork() == 0:
            if libc.vfork() == 0:
                libc.sleep(600)
            os._exit(0)
        yield number


def threads() -> Iterator[int]:
    """Threads."""
    threading.stack_size(65536)
    for number in count(1):
        try:
            threading.Thread(target=time.sleep, args=(600,), daemon=True).start()
        except RuntimeError as error:
            raise OSError(errno.EAGAIN, str(error)) from error
        yield number


def descriptors() -> Iterator[int]:
    """Open files."""
    for number in count(1):
        _kept.append(os.open("/dev/null", os.O_RDONLY))
        if number % 1000 == 0:
            yield number


def passing() -> Iterator[int]:
    """Descriptors that are on their way indefinitely, in sockets."""
    pieces = [os.open("/dev/null", os.O_RDONLY)] * 250
    for number in count(1):
        pair = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
        pair[0].setblocking(False)
        _kept.append(pair)
        with contextlib.suppress(BlockingIOError):
            while True:
                socket.send_fds(pair[0], [b"x"], pieces)
        yield number


def processors() -> Iterator[int]:
    """All processors, by many processes, for some time."""
    for _ in range(8):
        if os.fork() == 0:
            while True:
                pass
    for number in range(1, 15):
        time.sleep(0.1)
        yield number


def output() -> Iterator[int]:
    """A log without an end."""
    end = time.monotonic() + 1.2
    line = b"x" * 120 + b"\n"
    while time.monotonic() < end:
        os.write(1, line * 500)
    yield 1


def log_records() -> Iterator[int]:
    """Log records in ROS, from many names."""
    asyncio.run(_log())
    yield 1


async def _log() -> None:
    from rce.ros.node import Node

    async with Node("flood") as node:
        rosout = await node.advertise("/rosout", "rosgraph_msgs/Log", queue_size=100)
        end = time.monotonic() + 1.2
        numbers = count()
        while time.monotonic() < end:
            for number in islice(numbers, 20):
                rosout.publish(name=f"/nobody{number}", level=4, msg="y" * 20000)
            await asyncio.sleep(0.01)


def graph() -> Iterator[int]:
    """Topics, services and parameters without number, at the container's ROS core."""
    core = xmlrpc.client.ServerProxy(os.environ["ROS_MASTER_URI"])
    uri = "http://127.0.0.1:9/"
    end = time.monotonic() + 1.2
    for number in count(1):
        if time.monotonic() > end:
            break
        core.registerPublisher(f"/g{number}", f"/topic{number}", "std_msgs/String", uri)
        core.registerService(f"/g{number}", f"/service{number}", "rosrpc://127.0.0.1:9", uri)
        core.setParam("/g", f"/flood{number}", "z" * 20000)
        if number % 50 == 0:
            yield number


def flapping() -> Iterator[int]:
    """An interface that comes and goes, each time a report to the master."""
    yield asyncio.run(_flap())


async def _flap() -> int:
    from rce.ros.node import Node

    end = time.monotonic() + 1.2
    async with Node("flap") as node:
        for number in count(1):
            subscriber = await node.subscribe("/flap", "std_msgs/String", print)
            await subscriber.wait_for_publishers()
            await subscriber.close()
            if time.monotonic() > end:
                return number
    return 0


def stop_environment() -> Iterator[int]:
    """The environment does not run any more, nor does the node fork server."""
    os.kill(find_process("rce_container.forkserver.nodes"), signal.SIGSTOP)
    yield 1
    print(json.dumps({"ended": "stopped"}), flush=True)
    time.sleep(0.3)
    os.kill(find_process("rce_container.environment"), signal.SIGSTOP)
    time.sleep(600)


def kill_all() -> Iterator[int]:
    """Kill all that can be killed."""
    print("kills", flush=True)
    time.sleep(0.3)
    os.kill(1, signal.SIGKILL) if os.stat("/proc/1").st_uid == os.getuid() else None
    os.kill(-1, signal.SIGKILL)
    yield 1


MEMORY: dict[str, Callable[[], Iterator[int]]] = {
    "anonymous": anonymous,
    "home": files_in("/home/rce"),
    "tmp": files_in("/tmp"),
    "shm": files_in("/dev/shm"),
    "memfd": memfd,
    "shared": shared_segments,
    "pipes": pipes,
    "unix": unix_sockets,
    "tcp": tcp_sockets,
    "tables": page_tables,
}
OTHER: dict[str, Callable[[], Iterator[int]]] = {
    "empty": empty_files,
    "forks": forks,
    "zombies": zombies,
    "vforks": waiting_parents,
    "threads": threads,
    "files": descriptors,
    "passing": passing,
    "processors": processors,
    "output": output,
    "rosout": log_records,
    "graph": graph,
    "flapping": flapping,
    "stop": stop_environment,
    "kill": kill_all,
}


def _fill(write: Callable[[], int]) -> int:
    held = 0
    try:
        while True:
            held += write()
    except BlockingIOError:
        return held


def main(thing: str) -> None:
    """Take, until it is enough or no more is to be had."""
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    enough = ENOUGH_MB if thing in MEMORY else ENOUGH if thing not in ("empty", "files") else 1 << 30
    told = number = 0
    ended = "had enough"
    try:
        for number in {**MEMORY, **OTHER}[thing]():
            if number >= told + 8 or thing not in MEMORY:
                told = number
                print("has", number, flush=True)
            if number >= enough:
                break
    except OSError as error:
        ended = errno.errorcode.get(error.errno or 0, str(error))
    except Exception as error:  # noqa: BLE001 - whatever it is, it is a result
        ended = type(error).__name__
    print(json.dumps({"ended": ended, "has": number}), flush=True)
    while True:
        time.sleep(600)


if __name__ == "__main__":
    main(sys.argv[1])
