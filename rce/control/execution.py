"""Commands that are run in containers on a user's behalf: what is asked, and the frames of one run. Pure.

A run is a conversation of binary frames in both directions, each one byte that says what it is
(:class:`Part`) and its contents. The same frames go from the user's program to the master (a WebSocket at
``/api/v1/containers/{container}/exec``), from there to the container's machine (a WebSocket that the task set
dials, ``/exec/RUN`` on the control port) and into the container (a ``SOCK_SEQPACKET`` socket), so nothing on
the way reads more than the first byte.

A slow reader slows the command, and a command that does not read its input slows the user. If both sides can,
they do so by windows: each sends at most so many bytes of contents more than the other side took (``TAKEN``).
So nothing waits on the way, where it would delay signals, and pings of the connections. Otherwise each hop
waits for the next one.
"""

from __future__ import annotations

import re
import struct
from enum import Enum
from typing import NamedTuple

import msgspec
from msgspec import Struct

FEATURE = "exec"
"""The feature that a task set or an environment names if it can run commands."""
MAX_DATA = 32 << 10
"""Bytes of the contents of one frame."""
WINDOW = 256 << 10
"""Bytes of contents that may be on the way to the engine's programs."""
MIN_WINDOW = 2 * MAX_DATA
"""So that a command's output and its errors have room."""
MAX_SIDE = 0xFFFF
"""Rows and columns that a terminal may have."""
MAX_ARGUMENTS = 1024
MAX_COMMAND = 128 << 10
"""Bytes of a command with all its arguments and variables."""
NOT_RUN = 125
"""Exit code of a command that could not be run by the engine."""
PATH_PREFIX = "/exec/"
_RUN = re.compile(rf"{PATH_PREFIX}([0-9a-f]{{32}})")
_SIZE = struct.Struct("!HH")
_AMOUNT = struct.Struct("!I")


class Part(Enum):
    """The kind of a frame."""

    INPUT = b"i"
    """Bytes for the command's standard input."""
    END_OF_INPUT = b"c"
    SIZE = b"w"
    """The terminal's new size: rows and columns, two numbers of 16 bits in network order."""
    SIGNAL = b"s"
    """A signal's number, one byte, for the command's process group."""
    OUTPUT = b"o"
    ERROR = b"e"
    """Bytes of the command's standard error; with a terminal all is OUTPUT."""
    STARTED = b"b"
    """The command runs. If both sides use windows: the window for input, as in ``TAKEN``; otherwise empty."""
    TAKEN = b"t"
    """How many bytes of input, or of output and errors together, the sender of this frame took since its last
    one: 32 bits in network order. In both directions, if both sides use windows."""
    ENDED = b"x"
    """:class:`Ended` as JSON; the last frame."""


class Frame(NamedTuple):
    """A frame."""

    part: Part
    data: bytes = b""

    def encode(self) -> bytes:
        """Write it."""
        return self.part.value + self.data


class Command(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """The command to run."""

    argv: tuple[str, ...] = ()
    """The program and its arguments; empty: a shell."""
    tool: bool = False
    """``argv`` are the arguments of the engine's own :mod:`rce.ros.tools`."""
    terminal: bool = False
    """Give the command a terminal."""
    rows: int = 24
    columns: int = 80
    variables: dict[str, str] = {}
    """Further environment variables, such as TERM."""
    window: int = 0
    """How many bytes of output and errors may be on the way; 0: the user's program uses no windows."""


class Ended(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """How a command ended."""

    code: int
    """Its exit code, 128 and the signal's number if one ended it, or :data:`NOT_RUN`."""
    reason: str = ""
    """Why it could not be run, or was ended."""


def decode(frame: bytes) -> Frame:
    """Read a frame.

    Raises:
        ValueError: The data is not a frame.
    """
    if len(frame) > MAX_DATA + 1:
        raise ValueError(f"a frame of {len(frame)} bytes; at most {MAX_DATA + 1} are allowed")
    return Frame(Part(frame[:1]), frame[1:])


def size_frame(rows: int, columns: int) -> Frame:
    """Make the frame that tells a terminal's size."""
    return Frame(Part.SIZE, _SIZE.pack(min(rows, MAX_SIDE), min(columns, MAX_SIDE)))


def read_size(data: bytes) -> tuple[int, int]:
    """Read rows and columns.

    Raises:
        ValueError: It is not a size.
    """
    if len(data) != _SIZE.size:
        raise ValueError(f"a terminal's size has {_SIZE.size} bytes, not {len(data)}")
    rows, columns = _SIZE.unpack(data)
    return rows, columns


def amount_frame(part: Part, amount: int) -> Frame:
    """Make a frame that tells a number of bytes."""
    return Frame(part, _AMOUNT.pack(amount))


def read_amount(data: bytes) -> int:
    """Read a number of bytes.

    Raises:
        ValueError: It is none.
    """
    if len(data) != _AMOUNT.size:
        raise ValueError(f"a number of bytes has {_AMOUNT.size} bytes, not {len(data)}")
    return int(_AMOUNT.unpack(data)[0])


def ended_frame(code: int, reason: str = "") -> Frame:
    """Make the last frame."""
    return Frame(Part.ENDED, msgspec.json.encode(Ended(code=code, reason=reason[:2000])))


def read_ended(data: bytes) -> Ended:
    """Read the last frame.

    Raises:
        msgspec.ValidationError: The data is not a last frame.
    """
    return msgspec.json.decode(data, type=Ended)


def read_command(text: str | bytes) -> Command:
    """Read the command that a user wants to run.

    Raises:
        ValueError: The data is not a command, or it is too large; the text names the fault.
    """
    if len(text) > MAX_COMMAND:
        raise ValueError(f"the command has {len(text)} bytes; at most {MAX_COMMAND} are allowed")
    command = msgspec.json.decode(text, type=Command)
    if len(command.argv) > MAX_ARGUMENTS:
        raise ValueError(
            f"the command has {len(command.argv)} arguments; at most {MAX_ARGUMENTS} are allowed"
        )
    if command.window and command.window < MIN_WINDOW:
        raise ValueError(f"the window has {command.window} bytes; at least {MIN_WINDOW} are needed, or 0")
    if not (0 <= command.rows <= MAX_SIDE and 0 <= command.columns <= MAX_SIDE):
        raise ValueError(
            f"the terminal has {command.rows} rows and {command.columns} columns; 0 to {MAX_SIDE} are allowed"
        )
    texts = [*command.argv, *command.variables, *command.variables.values()]
    if any("\0" in one for one in texts) or any("=" in name or not name for name in command.variables):
        raise ValueError("arguments and variables hold no NUL, names of variables no '='")
    return command


def path_of(run: str) -> str:
    """Return the path that a task set dials for a run."""
    return f"{PATH_PREFIX}{run}"


def run_of(path: str) -> str | None:
    """Return the run that a path belongs to; None for any other path."""
    found = _RUN.fullmatch(path)
    return found[1] if found else None
