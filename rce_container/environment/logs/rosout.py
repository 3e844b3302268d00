"""Keeps ROS log records: each node's records go to its own log, and all records to one like ROS's."""

from __future__ import annotations

import logging
import time
from collections import Counter, deque
from collections.abc import Callable
from pathlib import Path

from rce.ros.logrecord import LogRecord, read_record, started
from rce_container.environment.logs.files import ROSOUT_LOG, LogWriter
from rce_container.environment.logs.node_log import NodeLog

_log = logging.getLogger(__name__)

WINDOW_S = 1.0
WINDOW_BYTES = 1 << 18
"""How much is kept of each node in a time window; more would slow down the environment."""
_MAX_WAITING = 200


class RosoutLog:
    """Writes log records to their logs.

    Args:
        folder: Where logs are.
        log_of: Finds a node's log by its name in ROS.
        clock: Seconds of a monotonic clock.

    Raises:
        OSError: The log cannot be opened.
    """

    def __init__(
        self, folder: Path, log_of: Callable[[str], NodeLog | None], clock: Callable[[], float]
    ) -> None:
        self._log_of = log_of
        self._clock = clock
        self._waiting: deque[LogRecord] = deque(maxlen=_MAX_WAITING)
        """Records of nodes that are not known yet: a node that registers is first asked for its process."""
        self._bytes: Counter[str] = Counter()
        self._dropped: Counter[str] = Counter()
        self._window_end = 0.0
        self._all = LogWriter(folder, ROSOUT_LOG)
        self._all.write(started(time.time()).encode())

    def take(self, payload: bytes, latched: bool = False) -> None:
        """Write a record."""
        del latched
        try:
            record = read_record(payload)
        except ValueError as error:
            _log.warning("%s", error)
            return
        if self._clock() >= self._window_end:
            self._begin_window()
        self._bytes[record.name] += len(payload)
        if self._bytes[record.name] > WINDOW_BYTES:
            self._dropped[record.name] += 1
            return
        self._all.write(record.in_file().encode(errors="replace") + b"\n")
        node_log = self._log_of(record.name)
        if node_log is not None:
            node_log.record(record)
        else:
            self._waiting.append(record)

    def known(self, name: str) -> None:
        """Note that a node of this name is one of the container's."""
        node_log = self._log_of(name)
        if node_log is None:
            return
        for record in [record for record in self._waiting if record.name == name]:
            node_log.record(record)
            self._waiting.remove(record)

    def close(self) -> None:
        """Log what was dropped, and close the file."""
        self._begin_window()
        self._all.close()

    def _begin_window(self) -> None:
        for name, count in self._dropped.items():
            text = f"{count} log records came too fast and were not kept"
            self._all.write(f"-- {name}: {text} --\n".encode())
            node_log = self._log_of(name)
            if node_log is not None:
                node_log.note(text)
        self._dropped.clear()
        self._bytes.clear()
        self._window_end = self._clock() + WINDOW_S
