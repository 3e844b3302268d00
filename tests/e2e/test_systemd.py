"""The engine as services of a systemd that runs: installed, killed, reloaded, stopped."""

from __future__ import annotations

import asyncio
import json
import shlex
import sys
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from support.booted import SYSTEMD, Booted, booted
from support.engine import until

pytestmark = [
    pytest.mark.e2e,
    pytest.mark.needs("root", "systemd", "cgroups", "netns", "bwrap"),
    pytest.mark.skipif(not SYSTEMD.exists(), reason="systemd is missing (Debian: systemd)"),
    pytest.mark.timeout(400),
]

BIN = Path(sys.executable).parent
UNITS = ("rce-master", "rce-robot", "rce-container")
TIMEOUT_S = 120.0

SETTINGS = """\
master: {bind: 127.0.0.1}
robot: {bind: 127.0.0.1, public_host: 127.0.0.1}
container: {bind: 127.0.0.1, runtime: namespace}
master_host: 127.0.0.1
"""
NODE = {"tag": "echo", "pkg": "Test", "exe": "stringEcho.py", "name": "echo"}


async def install(machine: Booted) -> None:
    machine.run(f"{BIN}/rce secret new /etc/rce/secret; cat >/etc/rce/engine.yaml", stdin=SETTINGS)
    machine.let_enter(sys.base_prefix, str(BIN))
    machine.run(
        f"{BIN}/rce user add alice --admin --password-stdin --state-dir /var/lib/rce/master",
        stdin="wonderland\n",
    )
    said = await machine.run_soon(f"{BIN}/rce install-service master")
    assert "created the user rce" in said
    roles = [machine.run_soon(f"{BIN}/rce install-service {role}") for role in ("robot", "container")]
    assert "made /etc/systemd/system/rce-robot.service" in "".join(await asyncio.gather(*roles))
    for unit in UNITS:
        await until(
            partial(_is_ready, machine, unit),
            timeout=TIMEOUT_S,
            what=f"{unit} is ready\n{machine.run(f'systemctl status {unit}', code=None)}",
        )


def main_pid(machine: Booted, unit: str) -> int:
    return int(machine.run(f"systemctl show --value -p MainPID {unit}"))


_ASK = """
import json, sys, urllib.request
method, path, body = json.load(sys.stdin)
def call(method, path, body, headers):
    url = "http://127.0.0.1:9000/api/v1" + path
    data = None if body is None else json.dumps(body).encode()
    with urllib.request.urlopen(urllib.request.Request(url, data, headers, method=method)) as reply:
        return json.loads(reply.read() or "null")
token = call("POST", "/login", {"userID": "alice", "password": "wonderland"}, {})["token"]
print(json.dumps(call(method, path, body, {"Authorization": "Bearer " + token})))
"""


def ask(machine: Booted, method: str, path: str, body: object = None) -> Any:
    """Ask the master's API."""
    reply = machine.run(f"{sys.executable} -c {shlex.quote(_ASK)}", stdin=json.dumps((method, path, body)))
    return json.loads(reply)


def node_pid(machine: Booted) -> int:
    """The pid of the container's node; 0 while it does not run, or the master does not know of it."""
    (container,) = ask(machine, "GET", "/containers")["containers"]
    pids = machine.run("pgrep -f '[s]tringEcho.py'", code=None).split()
    return int(pids[0]) if len(pids) == 1 and container["state"] == "running" else 0


def _is_ready(machine: Booted, unit: str) -> bool:
    return f"{unit} ready: " in machine.journal(unit)


async def test_services_survive_kills_and_reloads_and_stop_whole() -> None:
    async with booted() as machine:
        await install(machine)
        ask(machine, "POST", "/containers", {"tag": "box"})
        ask(machine, "POST", "/containers/box/nodes", NODE)
        node = await until(lambda: node_pid(machine), timeout=TIMEOUT_S, what="the node runs")
        assert "/rce-container.service/" in machine.run(f"cat /proc/{node}/cgroup"), "it has no cgroup"
        await asyncio.gather(check_restart(machine, "rce-master"), check_restart(machine, "rce-robot"))
        assert await until(lambda: node_pid(machine), timeout=TIMEOUT_S, what="the master knows") == node
        await check_new_secret(machine)
        assert await until(lambda: node_pid(machine), timeout=TIMEOUT_S, what="the node is known") == node
        await check_reload(machine)
        assert await until(lambda: node_pid(machine), timeout=TIMEOUT_S, what="it is adopted") == node
        machine.run("kill -KILL $(systemctl show --value -p MainPID rce-container)")
        await until(
            lambda: node_pid(machine) not in (0, node), timeout=TIMEOUT_S, what="the container is made again"
        )
        check_stop(machine)


async def check_restart(machine: Booted, unit: str) -> None:
    """Kill a program; systemd starts it again, and its log is in the journal."""
    before = machine.journal(unit).count(" ready: ")
    machine.run(f"kill -KILL {main_pid(machine, unit)}")
    await until(
        lambda: machine.journal(unit).count(" ready: ") > before, timeout=TIMEOUT_S, what=f"{unit} is back"
    )


async def check_new_secret(machine: Booted) -> None:
    """The running master takes a new secret, and refuses the old one: nothing of the services restarts."""
    assert machine.run("stat -c %U:%G:%a /etc/rce/secret").strip() == "root:rce:640"
    pids = [main_pid(machine, unit) for unit in UNITS]
    await machine.run_soon(f"{BIN}/rce secret rotate /etc/rce/secret")
    old = machine.run("tail -n 1 /etc/rce/secret").strip()
    new = machine.run("head -n 1 /etc/rce/secret").strip()
    assert [status_of(machine, secret) for secret in (old, new)] == [101, 101]
    before = times_connected(machine)
    await machine.run_soon(f"{BIN}/rce secret retire /etc/rce/secret")
    assert [status_of(machine, secret) for secret in (old, new)] == [401, 101]
    await until(
        lambda: all(now > then for now, then in zip(times_connected(machine), before, strict=True)),
        timeout=TIMEOUT_S,
        what="both task sets showed the new secret",
    )
    assert [main_pid(machine, unit) for unit in UNITS] == pids


_DIAL = """
import socket, sys
with socket.create_connection(("127.0.0.1", 8080), 30) as sock:
    sock.sendall(
        b"GET / HTTP/1.1\\r\\nHost: 127.0.0.1:8080\\r\\nUpgrade: websocket\\r\\nConnection: Upgrade\\r\\n"
        b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\\r\\nSec-WebSocket-Version: 13\\r\\n"
        b"Authorization: Bearer " + sys.stdin.read().encode() + b"\\r\\n\\r\\n"
    )
    print(sock.recv(100).split()[1].decode())
"""


def status_of(machine: Booted, secret: str) -> int:
    """Return what the master's control port answers one who shows a secret."""
    return int(machine.run(f"{sys.executable} -c {shlex.quote(_DIAL)}", stdin=secret))


def times_connected(machine: Booted) -> list[int]:
    """Return how often each task set connected to the master."""
    return [machine.journal(unit).count("connected to master") for unit in ("rce-robot", "rce-container")]


async def check_reload(machine: Booted) -> None:
    """A faulty settings file is told of and changes nothing; with a sound one the program starts anew."""
    pid = main_pid(machine, "rce-container")
    before = machine.journal("rce-container").count(" ready: ")
    machine.run("sed -i s/runtime:/runtimes:/ /etc/rce/engine.yaml")
    said = await machine.run_soon("systemctl reload rce-container", code=None)
    assert "failed" in said
    assert "container.runtimes: is not a known key; did you mean 'runtime'?" in machine.journal(
        "rce-container"
    )
    machine.run("sed -i 's/runtimes: namespace/runtime: namespace, labels: [reloaded]/' /etc/rce/engine.yaml")
    await machine.run_soon("systemctl reload rce-container")
    await until(
        lambda: machine.journal("rce-container").count(" ready: ") > before,
        timeout=TIMEOUT_S,
        what="rce-container is ready again",
    )
    assert main_pid(machine, "rce-container") == pid
    await until(lambda: labels(machine) == [["reloaded"]], timeout=TIMEOUT_S, what="the master knows them")


def labels(machine: Booted) -> list[list[str]]:
    """Return the labels of the machines that have any, as the master knows them."""
    found = ask(machine, "GET", "/machines")["machines"]
    return [one["labels"] for one in found if one["labels"]]


def check_stop(machine: Booted) -> None:
    """Nothing is left: no process, no cgroup, no socket."""
    for unit in UNITS:
        machine.run(f"systemctl stop {unit}")
        assert machine.run(f"systemctl show --value -p Result {unit}").strip() == "success"
        assert machine.run(f"find /sys/fs/cgroup -path '*{unit}.service*' -name 'rce-*'") == ""
        assert machine.run(f"ls /run/{unit}", code=2)
    assert machine.run("pgrep -fa '[r]ce_|[r]ce-|[b]wrap|[s]tringEcho'", code=1) == ""
