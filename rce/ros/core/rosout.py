"""The core's ``/rosout`` node: collects the log records of all nodes on one topic and in one file.

A tool that shows logs then holds one connection, to ``/rosout_agg``, instead of one to each node. Records are
passed on as they are on the wire; they are read only for the file.
"""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

from rce.ros.logfiles import LogFile, mark_latest
from rce.ros.node.member import DEFAULT_QUEUE
from rce.ros.node.node import Node
from rce.ros.node.rosout import KIND, MD5SUM, TOPIC
from rce.ros.node.runtime import TypeName

_log = logging.getLogger(__name__)

NAME = "rosout"
AGGREGATE = "/rosout_agg"

FILE = "rosout.log"
MAX_BYTES = 100_000_000
BACKUPS = 10
"""When the file is rotated, and how many older ones are kept: as ROS's rosout does."""

_WORDS = {1: "DEBUG", 2: "INFO", 4: "WARN", 8: "ERROR", 16: "FATAL"}


class RosoutNode(Node):
    """The node ``/rosout``. An async context manager."""

    def __init__(self, master_uri: str, host: str, log_folder: Path | None = None) -> None:
        """Prepare the node.

        Args:
            master_uri: The core.
            host: Under which others reach the node.
            log_folder: Where ``rosout.log`` is written; ``None``: nowhere.
        """
        super().__init__(
            NAME,
            namespace="/",
            argv=[f"__hostname:={host}"],
            master_uri=master_uri,
            signals=False,
            rosout=False,
        )
        self._log_folder = log_folder
        self._file: LogFile | None = None

    async def gather(self) -> None:
        """Begin to pass records on."""
        aggregate = await self._topics.advertise(
            self._running, AGGREGATE, KIND, latch=False, queue_size=DEFAULT_QUEUE
        )
        if self._log_folder is not None:
            self._open_file(self._log_folder)

        def take(payload: bytes, _latched: bool) -> None:
            aggregate.publish_serialized(payload)
            if self._file is not None:
                self._write(self._file, payload)

        await self.subscribe_serialized(TOPIC, TypeName(KIND, MD5SUM), take)

    def _open_file(self, folder: Path) -> None:
        try:
            file = LogFile(folder / FILE, "%(message)s", max_bytes=MAX_BYTES, backups=BACKUPS)
        except OSError as error:
            _log.warning("there is no %s: %s (ROS_LOG_DIR names another folder)", folder / FILE, error)
            return
        mark_latest(folder)
        self._file = file
        self._stack.callback(self._close_file)
        now = self.now()
        _append(file, f"\n\n{now.secs}.{now.nsecs:09}  Node Startup")

    def _close_file(self) -> None:
        file, self._file = self._file, None
        if file is not None:
            file.close()

    def _write(self, file: LogFile, payload: bytes) -> None:
        try:
            record = self._types.message(KIND).deserialize(payload)
        except ValueError as error:
            _log.warning("a record that cannot be read: %s", error)
            return
        _append(file, describe(record))


def describe(record: Any) -> str:
    """Write a ``rosgraph_msgs/Log`` on a line, in the form of ROS's ``rosout.log``."""
    stamp = record.header.stamp
    level = _WORDS.get(record.level, str(record.level))
    place = f"{record.file}:{record.line}({record.function})"
    topics = ", ".join(record.topics)
    return f"{stamp.secs}.{stamp.nsecs:09} {level} {record.name} [{place}] [topics: {topics}] {record.msg}"


def _append(file: LogFile, line: str) -> None:
    file.handle(logging.makeLogRecord({"msg": line}))
