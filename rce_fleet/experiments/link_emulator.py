"""A link between two TAP interfaces that delays and loses frames: ``python -m ...link_emulator``.

It carries Ethernet frames, multicast among them. The kernel's ``netem`` would do the same and is not
everywhere. Prints ``ready``.

Each line of standard input is a JSON object: ``{"delay": 0.01, "jitter": 0, "loss": 0}`` gives the link
another shape, ``{}`` none. The answer is a line of JSON with what was measured so far: frames carried and
lost in each direction, and the processor time that it took, seconds. The same line is printed at the end,
which comes with SIGINT, SIGTERM, or the end of standard input.
"""

from __future__ import annotations

import argparse
import fcntl
import json
import os
import select
import signal
import struct
import sys
import time
from dataclasses import dataclass

from rce_fleet.experiments.delay_line import DelayLine, LinkShape

_TUNSETIFF = 0x400454CA
_IFF_TAP, _IFF_NO_PI = 0x0002, 0x1000
"""From linux/if_tun.h."""
_NAME_LENGTH = 15
_MAX_FRAME = 65_536
_BURST = 64
"""Frames that are read of one interface before the other one's turn."""


@dataclass(frozen=True, slots=True)
class Direction:
    """Frames from one interface to the other one."""

    source: int
    target: int
    line: DelayLine


def open_tap(name: str) -> int:
    """Create a TAP interface; it exists until the file is closed, in whatever namespace it is moved to.

    Raises:
        ValueError: The name is too long.
        OSError: It cannot be made.
    """
    if not 0 < len(name) <= _NAME_LENGTH:
        raise ValueError(f"the name of an interface has 1 to {_NAME_LENGTH} characters: {name!r}")
    file = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        fcntl.ioctl(file, _TUNSETIFF, struct.pack("16sH22x", name.encode(), _IFF_TAP | _IFF_NO_PI))
    except OSError:
        os.close(file)
        raise
    return file


class Orders:
    """What the program is told on its standard input, and its answers.

    Args:
        source: File descriptor of the orders.
        directions: What they are about.
    """

    def __init__(self, source: int, directions: list[Direction]) -> None:
        self.source = source
        self._directions = directions
        self._rest = b""

    def read(self) -> bool:
        """Follow the orders that have arrived; return whether there may be more.

        Raises:
            ValueError, TypeError: An order is not one.
        """
        data = os.read(self.source, _MAX_FRAME)
        *lines, self._rest = (self._rest + data).split(b"\n")
        for line in lines:
            values = json.loads(line)
            if values:
                shape = LinkShape(**values)
                for direction in self._directions:
                    direction.line.reshape(shape)
            self.answer()
        return bool(data)

    def answer(self) -> None:
        """Print what was measured."""
        figures = {
            name: {"carried": direction.line.carried, "lost": direction.line.lost}
            for name, direction in zip(("there", "back"), self._directions, strict=True)
        }
        print(json.dumps({**figures, "cpu_s": time.process_time()}), flush=True)  # noqa: T201


def carry(directions: list[Direction], wake: int, orders: Orders) -> None:
    """Carry frames until ``wake`` can be read, or the orders end.

    Raises:
        ValueError, TypeError: An order is not one.
    """
    by_source = {direction.source: direction for direction in directions}
    while True:
        now = time.monotonic()
        for direction in directions:
            for frame in direction.line.take(now):
                _write(direction.target, frame)
        waits = max(0.0, min(direction.line.next_at for direction in directions) - time.monotonic())
        readable, _, _ = select.select([*by_source, wake, orders.source], [], [], min(waits, 3600.0))
        if wake in readable or (orders.source in readable and not orders.read()):
            return
        for source in by_source.keys() & set(readable):
            _read(by_source[source])


def _read(direction: Direction) -> None:
    for _ in range(_BURST):
        try:
            frame = os.read(direction.source, _MAX_FRAME)
        except (BlockingIOError, OSError):  # EIO: the interface is down
            return
        direction.line.put(frame, time.monotonic())


def _write(target: int, frame: bytes) -> None:
    try:
        os.write(target, frame)
    except OSError:  # the interface is down: as with a cable that is unplugged, the frame is lost
        return


def main() -> int:
    """Run the program until SIGINT or SIGTERM; return its exit code."""
    parser = argparse.ArgumentParser(prog="link_emulator", description=__doc__)
    parser.add_argument("left", help="name of the first interface")
    parser.add_argument("right", help="name of the second one")
    parser.add_argument("--delay", type=float, default=0.0, help="seconds")
    parser.add_argument("--jitter", type=float, default=0.0, help="seconds")
    parser.add_argument("--loss", type=float, default=0.0, help="share of frames, 0 to 1")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    try:
        shape = LinkShape(options.delay, options.jitter, options.loss)
        left, right = open_tap(options.left), open_tap(options.right)
    except (ValueError, OSError) as error:
        print(f"link_emulator: {error}", file=sys.stderr)  # noqa: T201
        return 1
    woken, waker = os.pipe()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: None)
    os.set_blocking(waker, False)
    signal.set_wakeup_fd(waker)
    there = Direction(left, right, DelayLine(shape, options.seed))
    back = Direction(right, left, DelayLine(shape, options.seed + 1))
    directions = [there, back]
    orders = Orders(sys.stdin.fileno(), directions)
    print("ready", flush=True)  # noqa: T201
    try:
        carry(directions, woken, orders)
    except (ValueError, TypeError) as error:
        print(f"link_emulator: an order cannot be followed: {error}", file=sys.stderr)  # noqa: T201
        return 1
    orders.answer()
    return 0


if __name__ == "__main__":
    sys.exit(main())
