"""The audit of dependencies, with a database of vulnerabilities that a test serves."""

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
from support.ports import free_ports

ROOT = Path(__file__).parents[3]
FLAW = {
    "id": "OSV-0000-1",
    "summary": "a flaw",
    "published": "2026-01-01T00:00:00Z",
    "affected": [
        {
            "package": {"name": "pyyaml", "ecosystem": "PyPI"},
            "ranges": [{"type": "ECOSYSTEM", "events": [{"introduced": "0"}, {"fixed": "99.1"}]}],
        }
    ],
}

pytestmark = pytest.mark.timeout(300)


@contextmanager
def database(vulnerable: str) -> Iterator[str]:
    """Serve a database that knows one flaw of one package; gives its URL."""

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            query = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
            body = json.dumps({"vulns": [FLAW]} if query["package"]["name"] == vulnerable else {}).encode()
            self.send_response(200)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, *args: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_port}/v1/query"
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


def audit(url: str) -> subprocess.CompletedProcess[str]:
    options = ["--vulnerability-service", "osv", "--osv-url", url, "--timeout", "20"]
    return subprocess.run(
        [sys.executable, "-m", "tools.audit", *options],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )


def test_vulnerable_dependency_fails() -> None:
    with database("pyyaml") as url:
        done = audit(url)
    assert done.returncode == 1
    assert "pyyaml" in done.stderr
    assert "is vulnerable: OSV-0000-1, fixed in 99.1" in done.stderr


def test_clean_dependencies_pass() -> None:
    with database("nothing") as url:
        done = audit(url)
    assert done.returncode == 0, done.stderr
    assert "have no known vulnerability" in done.stdout


def test_database_out_of_reach_is_told_in_one_line() -> None:
    done = audit(f"http://127.0.0.1:{free_ports(1)[0]}/v1/query")
    assert done.returncode == 0, done.stderr
    (line,) = (done.stdout + done.stderr).splitlines()
    assert line.startswith("audit: not audited: the database of vulnerabilities cannot be reached")
