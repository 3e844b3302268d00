"""Measures a link between two machines: ``link_probe serve ADDRESS`` on one, ``measure ADDRESS`` on another.

It prints one line of JSON: ``round_trip_s`` (median), ``round_trip_p99_s``, ``lost`` (share of the probes
without an answer), ``rate`` and ``rate_back`` (payload of TCP there and back, bits per second).
"""

from __future__ import annotations

import argparse
import contextlib
import json
import socket
import sys
import threading
import time

import numpy as np

PORT = 5099
PROBES = 100
PROBE_EVERY = 0.01
PROBE_TIMEOUT = 1.0
RATE_SECONDS = 2.0
_CHUNK = 65_536


def serve(address: str) -> None:
    """Answer probes, take streams and send others back, until killed."""
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probes,
        socket.create_server((address, PORT)) as streams,
    ):
        probes.bind((address, PORT))
        threading.Thread(target=_answer, args=(probes,), daemon=True).start()
        print("ready", flush=True)  # noqa: T201
        while True:
            stream, _ = streams.accept()
            with stream:
                _take(stream)


def measure(address: str) -> dict[str, float]:
    """Measure the link to a machine where the probe is served.

    Raises:
        OSError: It is not reached.
    """
    trips = _round_trips(address)
    there, back = _rates(address)
    return {
        "round_trip_s": float(np.median(trips)) if trips else float("inf"),
        "round_trip_p99_s": float(np.percentile(trips, 99)) if trips else float("inf"),
        "lost": 1 - len(trips) / PROBES,
        "rate": there,
        "rate_back": back,
    }


def _answer(probes: socket.socket) -> None:
    with contextlib.suppress(OSError):  # closed
        while True:
            data, sender = probes.recvfrom(_CHUNK)
            probes.sendto(data, sender)


def _take(stream: socket.socket) -> None:
    """Read a stream to its end, tell how many bytes came, and send a stream back."""
    taken = 0
    with contextlib.suppress(OSError):
        while data := stream.recv(_CHUNK):
            taken += len(data)
        stream.sendall(f"{taken}\n".encode())
        _send(stream)


def _send(stream: socket.socket) -> None:
    chunk = bytes(_CHUNK)
    began = time.monotonic()
    while time.monotonic() - began < RATE_SECONDS:
        stream.sendall(chunk)


def _round_trips(address: str) -> list[float]:
    sent: dict[int, float] = {}
    trips = []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.connect((address, PORT))
        due = time.monotonic()
        for number in range(PROBES + 1):
            if number < PROBES:
                sent[number] = time.monotonic()
                probe.send(number.to_bytes(4, "big"))
            due += PROBE_EVERY if number < PROBES else PROBE_TIMEOUT
            while sent and (left := due - time.monotonic()) > 0:
                probe.settimeout(left)
                try:
                    answered = int.from_bytes(probe.recv(16), "big")
                except TimeoutError:
                    break
                if answered in sent:
                    trips.append(time.monotonic() - sent.pop(answered))
    return trips


def _rates(address: str) -> tuple[float, float]:
    """Return the rates of a stream there and of one back, bits per second."""
    with socket.create_connection((address, PORT)) as stream:
        began = time.monotonic()
        _send(stream)
        stream.shutdown(socket.SHUT_WR)
        taken = int(stream.recv(64).partition(b"\n")[0])
        there = 8 * taken / (time.monotonic() - began)
        began, back = time.monotonic(), 0
        while data := stream.recv(_CHUNK):
            back += len(data)
        return there, 8 * back / (time.monotonic() - began)


def main() -> int:
    """Run the program; return its exit code."""
    parser = argparse.ArgumentParser(prog="link_probe", description=__doc__)
    parser.add_argument("what", choices=("serve", "measure"))
    parser.add_argument("address")
    options = parser.parse_args()
    try:
        if options.what == "serve":
            serve(options.address)
        print(json.dumps(measure(options.address)))  # noqa: T201
    except OSError as error:
        print(f"link_probe: {options.address}: {error}", file=sys.stderr)  # noqa: T201
        return 1
    except KeyboardInterrupt:
        pass
    return 0


if __name__ == "__main__":
    sys.exit(main())
