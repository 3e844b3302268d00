"""The node fork server, when it answers late or not at all."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from rce_container.environment.nodes import fork_server
from rce_container.environment.nodes.fork_server import NodeForkServer

SERVE = """
import socket, sys
from rce_container.forkserver.nodes import serve
serve(socket.socket(fileno=int(sys.argv[1])))
"""


def spawn(server: NodeForkServer, script: Path, stream: int) -> int:
    argv = [sys.executable, str(script)]
    return server.spawn(argv, env=dict(os.environ), cwd=str(script.parent), stdout=stream, stderr=stream)


@pytest.fixture
def script(tmp_path: Path) -> Path:
    """A script that leaves a file."""
    path = tmp_path / "node.py"
    path.write_text(f"import pathlib; pathlib.Path({str(tmp_path / 'ran')!r}).touch()\n")
    return path


def test_a_late_order_is_not_executed(script: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The environment has started the node in the ordinary way meanwhile."""
    monkeypatch.setattr(fork_server, "_TIMEOUT_S", 0.2)
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    argv = [sys.executable, "-c", SERVE, str(theirs.fileno())]
    with subprocess.Popen(argv, pass_fds=[theirs.fileno()]) as process:
        theirs.close()
        process.send_signal(signal.SIGSTOP)
        reading, writing = os.pipe()
        assert spawn(NodeForkServer(ours), script, writing) == 0
        os.close(writing)
        process.send_signal(signal.SIGCONT)
        assert process.wait(60) == 0
    with open(reading, "rb") as stream:  # noqa: PTH123 - a descriptor
        assert stream.read() == b"", "what was forked has ended without a word"
    assert not (script.parent / "ran").exists()


def test_an_order_is_executed_in_time(script: Path) -> None:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    argv = [sys.executable, "-c", SERVE, str(theirs.fileno())]
    with subprocess.Popen(argv, pass_fds=[theirs.fileno()]) as process:
        theirs.close()
        reading, writing = os.pipe()
        server = NodeForkServer(ours)
        ours.settimeout(60)
        pid = spawn(server, script, writing)
        os.close(writing)
        assert pid not in (0, process.pid)
        server.close()
        assert process.wait(60) == 0
    with open(reading, "rb") as stream:  # noqa: PTH123 - a descriptor
        assert stream.read() == b""
    assert (script.parent / "ran").exists()


def test_an_answer_at_the_last_moment_counts(script: Path) -> None:
    """The process runs, so the node must not be started again."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)

    class Late(socket.socket):
        answered = False

        def recv(self, size: int, flags: int = 0, /) -> bytes:
            if not self.answered:
                self.answered = True
                theirs.send(b"41")
                raise TimeoutError
            return super().recv(size, flags)

    with theirs, Late(fileno=ours.detach()) as late:
        server = NodeForkServer(late)
        assert spawn(server, script, 0) == 41
        assert spawn(server, script, 0) == 0
        with pytest.raises(BrokenPipeError):
            theirs.send(b"42")
