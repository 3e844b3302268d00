"""The programs that log in and print a node's output: an engine that answers, and one that is away."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from rce_fleet.experiments import engine_login, node_log

TEXT = "what the node printed\n"


class Engine(BaseHTTPRequestHandler):
    """Answers requests for the log in one chunk, or with ``status``."""

    status = 200

    def do_GET(self) -> None:
        if self.status == 0:
            return  # the connection ends without an answer, as of a killed master
        offset = int(self.path.rpartition("offset=")[2])
        answer = json.dumps({"text": TEXT[offset:], "offset": len(TEXT)}).encode()
        self.send_response(self.status)
        self.end_headers()
        self.wfile.write(answer)

    def do_POST(self) -> None:
        account = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
        self.send_response(self.status)
        self.end_headers()
        self.wfile.write(json.dumps({"token": f"of {account['userID']} with {account['password']}"}).encode())

    def log_message(self, format: str, *args: object) -> None:  # noqa: A002
        del format, args


@contextmanager
def engine(status: int) -> Iterator[int]:
    """An engine that answers with a status; yields its port."""
    handler = type("Answering", (Engine,), {"status": status})
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield server.server_port
        finally:
            server.shutdown()
            thread.join()


def printed(folder: Path, port: int) -> subprocess.CompletedProcess[str]:
    login = folder / "login.json"
    login.write_text(json.dumps({"url": f"http://127.0.0.1:{port}/", "token": "secret"}))
    return subprocess.run(
        [sys.executable, "-I", "-S", node_log.__file__, str(login), "box", "node"],
        check=False,
        capture_output=True,
        text=True,
    )


def test_log_of_a_node_is_printed(tmp_path: Path) -> None:
    with engine(200) as port:
        done = printed(tmp_path, port)
    assert (done.returncode, done.stdout) == (0, TEXT), done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("status", [0, node_log.UNAVAILABLE])
def test_nothing_is_printed_while_the_engine_cannot_answer(tmp_path: Path, status: int) -> None:
    with engine(status) as port:
        done = printed(tmp_path, port)
    assert (done.returncode, done.stdout) == (0, ""), done.stderr


def test_nothing_is_printed_while_the_master_is_away(tmp_path: Path) -> None:
    with engine(200) as port:
        pass
    done = printed(tmp_path, port)
    assert (done.returncode, done.stdout) == (0, ""), done.stderr


def test_refusal_is_an_error(tmp_path: Path) -> None:
    with engine(401) as port:
        done = printed(tmp_path, port)
    assert done.returncode != 0
    assert "401" in done.stderr


def test_login_writes_what_the_log_needs(tmp_path: Path) -> None:
    file = tmp_path / "login.json"
    with engine(200) as port:
        url = f"http://127.0.0.1:{port}/"
        argv = [sys.executable, "-I", "-S", engine_login.__file__, url, "researcher", str(file)]
        subprocess.run(argv, input="experiment", check=True, capture_output=True, text=True)
    assert json.loads(file.read_text()) == {"url": url, "token": "of researcher with experiment"}
    assert file.stat().st_mode & 0o077 == 0
