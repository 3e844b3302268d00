"""The link between machines delays, loses and carries multicast, measured by programs on both sides."""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

pytestmark = pytest.mark.needs("netns")

LEFT, RIGHT = "10.88.0.1", "10.88.0.2"
GROUP, PORT = "226.0.0.0", 5000
START_S = 30.0
ECHO = """
import socket, sys
group, own, port = sys.argv[1:]
sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
sock.bind(("", int(port)))
sock.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, socket.inet_aton(group) + socket.inet_aton(own))
print("ready", flush=True)
while True:
    data, sender = sock.recvfrom(2000)
    sock.sendto(data, sender)
"""
ASK = """
import json, socket, sys, time
own, target, port, count = sys.argv[1:]
sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
sock.bind((own, 0))
sock.settimeout(1.0)
trips = []
for number in range(int(count)):
    began = time.monotonic()
    sock.sendto(number.to_bytes(4, "big"), (target, int(port)))
    try:
        while sock.recv(2000) != number.to_bytes(4, "big"):
            pass
    except TimeoutError:
        continue
    trips.append(time.monotonic() - began)
print(json.dumps(trips))
"""


def ip(*words: str) -> None:
    subprocess.run(["ip", *words], check=True, capture_output=True)


@contextmanager
def link(*options: str) -> Iterator[tuple[str, str, subprocess.Popen[str]]]:
    """Two machines with a link; gives their namespaces and the emulator."""
    tag = f"rcl{os.getpid()}"
    names = {f"{tag}a": LEFT, f"{tag}b": RIGHT}
    argv = [sys.executable, "-m", "rce_fleet.experiments.link_emulator", *names, *options]
    with subprocess.Popen(argv, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as emulator:
        try:
            assert emulator.stdout is not None
            assert emulator.stdout.readline() == "ready\n"
            for name, address in names.items():
                ip("netns", "add", name)
                ip("link", "set", name, "netns", name)
                ip("-n", name, "address", "add", f"{address}/24", "dev", name)
                ip("-n", name, "link", "set", name, "up")
                ip("-n", name, "route", "add", "224.0.0.0/4", "dev", name)
            left, right = names
            yield left, right, emulator
        finally:
            if emulator.poll() is None:
                emulator.terminate()
                emulator.wait(START_S)
            for name in names:
                subprocess.run(["ip", "netns", "del", name], check=False, capture_output=True)


@contextmanager
def program(namespace: str, text: str, *words: object) -> Iterator[subprocess.Popen[str]]:
    """Run a Python program on a machine."""
    argv = ["ip", "netns", "exec", namespace, sys.executable, "-c", text, *map(str, words)]
    with subprocess.Popen(argv, stdout=subprocess.PIPE, text=True) as process:
        try:
            yield process
        finally:
            process.kill()


def trips(left: str, right: str, target: str, count: int) -> list[float]:
    """Return the round trips of the datagrams that came back, seconds."""
    with program(right, ECHO, GROUP, RIGHT, PORT) as echo:
        assert echo.stdout is not None
        assert echo.stdout.readline() == "ready\n"
        with program(left, ASK, LEFT, target, PORT, count) as ask:
            out, _ = ask.communicate(timeout=START_S + count)
            found: list[float] = json.loads(out)
            return found


@pytest.mark.parametrize("target", [RIGHT, GROUP], ids=["unicast", "multicast"])
def test_both_directions_are_delayed(target: str) -> None:
    with link("--delay", "0.05", "--jitter", "0.005") as (left, right, _):
        found = trips(left, right, target, 10)
        assert len(found) == 10
        assert min(found) >= 0.09
        assert statistics.median(found) >= 0.095


def test_frames_are_lost_and_counted() -> None:
    with link("--loss", "0.3", "--seed", "3") as (left, right, emulator):
        found = trips(left, right, RIGHT, 20)
        assert 0 < len(found) < 20
        emulator.terminate()
        out, _ = emulator.communicate(timeout=START_S)
        figures = json.loads(out)
        assert figures["there"]["lost"] > 0
        assert figures["back"]["lost"] > 0
        assert figures["there"]["carried"] >= len(found)
        assert figures["cpu_s"] > 0


def test_a_link_gets_another_shape_and_tells_what_it_carried() -> None:
    with link() as (left, right, emulator):
        assert emulator.stdin is not None
        assert emulator.stdout is not None
        assert statistics.median(trips(left, right, RIGHT, 5)) < 0.04
        emulator.stdin.write('{"delay": 0.05}\n')
        emulator.stdin.flush()
        carried = json.loads(emulator.stdout.readline())["there"]["carried"]
        assert carried >= 5
        assert statistics.median(trips(left, right, RIGHT, 5)) >= 0.095
        emulator.stdin.write("{}\n")
        emulator.stdin.flush()
        assert json.loads(emulator.stdout.readline())["there"]["carried"] >= carried + 5
        emulator.stdin.close()
        assert emulator.wait(START_S) == 0, "it ends with its standard input"


def test_a_bad_order_is_named() -> None:
    names = [f"rcl{os.getpid()}a", f"rcl{os.getpid()}b"]
    argv = [sys.executable, "-m", "rce_fleet.experiments.link_emulator", *names]
    order = '{"delay": -1}\n'
    done = subprocess.run(argv, check=False, input=order, capture_output=True, text=True, timeout=START_S)
    assert done.returncode == 1
    assert "an order cannot be followed: jitter and delay need" in done.stderr


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (("a" * 16, "b"), "1 to 15 characters"),
        (("rcla", "rclb", "--loss", "2"), "must be within 0 .. 1"),
        (("rcla", "rclb", "--delay", "-1"), "0 <= jitter <= delay"),
    ],
)
def test_impossible_links_are_refused(words: tuple[str, ...], text: str) -> None:
    argv = [sys.executable, "-m", "rce_fleet.experiments.link_emulator", *words]
    done = subprocess.run(argv, check=False, capture_output=True, text=True)
    assert done.returncode == 1
    assert done.stderr.startswith("link_emulator: ")
    assert text in done.stderr
