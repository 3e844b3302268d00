"""The log of one node: its output, its ROS log records and its state changes, in order of arrival."""

from __future__ import annotations

from pathlib import Path

from rce.ros.logrecord import LogRecord
from rce_container.environment.logs import streams
from rce_container.environment.logs.files import LogWriter

_WORDS_BYTES = 2048
_WORDS_LENGTH = 300


class Words:
    """Remembers the last line that is not empty."""

    def __init__(self) -> None:
        self._tail = b""

    def take(self, data: bytes) -> None:
        """Process written data."""
        self._tail = (self._tail + data[-_WORDS_BYTES:])[-_WORDS_BYTES:]

    def __str__(self) -> str:
        lines = self._tail.decode(errors="replace").strip().splitlines()
        return lines[-1].strip()[:_WORDS_LENGTH] if lines else ""


class NodeLog:
    """Writes a node's log, across all its restarts.

    Args:
        folder: Where logs are.
        tag: The node.

    Raises:
        OSError: The log cannot be opened.
    """

    def __init__(self, folder: Path, tag: str) -> None:
        self._writer = LogWriter(folder, tag)
        self._rests = {streams.STDOUT: b"", streams.STDERR: b""}
        """Incomplete characters, whose remaining bytes have not arrived yet."""
        self._open_lines: set[bytes] = set()
        self._words: dict[bytes, Words] = {}
        self.begin()

    def begin(self) -> None:
        """Note that the node starts again."""
        self._words = {streams.STDOUT: Words(), streams.STDERR: Words()}

    def stdout(self, data: bytes) -> None:
        """Write data from the node's standard output."""
        self._print(streams.STDOUT, data)

    def stderr(self, data: bytes) -> None:
        """Write data from the node's standard error."""
        self._print(streams.STDERR, data)

    def record(self, record: LogRecord) -> None:
        """Write a log record that the node sent to ``/rosout``."""
        line = record.on_console().encode(errors="replace")
        self._writer.write(streams.fragments(streams.letter_of(record.level), line + b"\n"))

    def note(self, text: str) -> None:
        """Write a message of the engine about the node, on a separate line."""
        for letter, rest in self._rests.items():
            if rest or letter in self._open_lines:
                self._writer.write(streams.fragments(letter, rest + b"\n"))
                self._rests[letter] = b""
        self._open_lines.clear()
        self._writer.write(streams.fragments(streams.ENGINE, f"-- {text} --\n".encode(errors="replace")))

    @property
    def last_output(self) -> str:
        """Return the newest life's last line of standard error; of standard output if that is empty."""
        return str(self._words[streams.STDERR]) or str(self._words[streams.STDOUT])

    def close(self) -> None:
        """Close the file."""
        self._writer.close()

    def _print(self, letter: bytes, data: bytes) -> None:
        self._words[letter].take(data)
        data = self._rests[letter] + data
        whole = streams.whole_characters(data)
        data, self._rests[letter] = data[:whole], data[whole:]
        if not data:
            return
        self._writer.write(streams.fragments(letter, data))
        if data.endswith(b"\n"):
            self._open_lines.discard(letter)
        else:
            self._open_lines.add(letter)
