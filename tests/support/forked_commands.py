"""Commands of the ``rce`` program as processes that are forked from one that has imported them.

A start of ``rce`` takes half a second of CPU, nearly all of it imports. Tests that run many short commands
share the imports: :func:`run_command` gives each a process of its own, with its arguments, environment,
folder, input and output. Tests of the program's start, of signals and of terminals start the program itself.

Each pytest process has a server of its own, which ends with it.
"""

from __future__ import annotations

import asyncio
import importlib
import json
import os
import select
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import traceback
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any, NoReturn

import psutil

TESTS = Path(__file__).parents[1]
MODULES = ("audit", "backup", "execute", "follow", "graph", "packages", "session", "show", "tokens", "users")
TIMEOUT_S = 300.0
LOOK_FOR_OWNER_S = 2.0
_starting = threading.Lock()


async def run_command(
    words: tuple[str, ...], *, env: Mapping[str, str], folder: Path, typed: str = ""
) -> tuple[int, str]:
    """Run ``rce WORDS`` and return its exit code and what it printed, on both streams."""
    return await asyncio.to_thread(_run, words, dict(env), folder, typed)


def _run(words: tuple[str, ...], env: dict[str, str], folder: Path, typed: str) -> tuple[int, str]:
    with _starting:
        path = _server()
    request = json.dumps({"words": words, "env": env, "folder": str(folder)}).encode()
    with (
        tempfile.TemporaryFile() as given,
        tempfile.TemporaryFile() as output,
        socket.socket(socket.AF_UNIX) as server,
    ):
        given.write(typed.encode())
        given.seek(0)
        server.settimeout(TIMEOUT_S)
        server.connect(path)
        socket.send_fds(server, [len(request).to_bytes(4, "big")], [given.fileno(), output.fileno()])
        server.sendall(request)
        answer = server.recv(16)
        output.seek(0)
        text = output.read().decode()
    assert answer, f"the server of commands ended; so far: {text}"
    return int(answer), text


@cache
def _server() -> str:
    """Start the server, which is not a child of this process, and return the path of its socket."""
    folder = tempfile.mkdtemp(prefix="rce-commands-", dir="/tmp")
    path = f"{folder}/socket"
    subprocess.run(
        [sys.executable, "-P", "-m", "support.forked_commands", path, str(os.getpid())],
        env={
            **os.environ,
            "PYTHONPATH": os.pathsep.join(filter(None, (str(TESTS), os.environ.get("PYTHONPATH")))),
        },
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        check=True,
    )
    return path


def serve(path: str, owner: int) -> None:
    """Listen in a process in the background, and fork commands there until the owner has ended."""
    process = psutil.Process(owner)
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(path)
        listener.listen(16)
        if os.fork():
            os._exit(0)
        os.setsid()
        for module in MODULES:
            importlib.import_module(f"rce_master.cli.{module}")
        signal.signal(signal.SIGCHLD, signal.SIG_IGN)
        while process.is_running():
            if select.select([listener], [], [], LOOK_FOR_OWNER_S)[0]:
                connection, _ = listener.accept()
                if os.fork() == 0:
                    _carry_out(connection)
                connection.close()
    shutil.rmtree(Path(path).parent, ignore_errors=True)


def _carry_out(connection: socket.socket) -> NoReturn:
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    size, descriptors, *_ = socket.recv_fds(connection, 4, 2)
    with connection.makefile("rb") as stream:
        request = json.loads(stream.read(int.from_bytes(size, "big")))
    command = os.fork()
    if command == 0:
        connection.close()
        given, output = descriptors
        for source, target in ((given, 0), (output, 1), (output, 2)):
            os.dup2(source, target)
        os._exit(_run_here(request))
    _, status = os.waitpid(command, 0)
    connection.sendall(str(os.waitstatus_to_exitcode(status)).encode())
    os._exit(0)


def _run_here(request: dict[str, Any]) -> int:
    from rce.cli.main import main

    os.environ.clear()
    os.environ.update(request["env"])
    os.chdir(request["folder"])
    sys.argv = ["rce", *request["words"]]
    code: object = 0
    try:
        main()
    except SystemExit as end:
        code = end.code or 0
    except BaseException:  # noqa: BLE001 - as the interpreter does at the end of a program
        traceback.print_exc()
        code = 1
    sys.stdout.flush()
    sys.stderr.flush()
    return code if isinstance(code, int) else 1


if __name__ == "__main__":
    serve(sys.argv[1], int(sys.argv[2]))
