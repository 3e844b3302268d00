"""Files of a finished run, all or none, and the progress on the way."""

from __future__ import annotations

import json
import shutil
import tempfile
import threading
import time
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, TextIO

from rce_fleet.compiled import compile_kernels
from rce_fleet.exceptions import LogError

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from rce_fleet.mapping.records import LaserRecord

REDRAW_S = 0.2
SHARE = 0.1
"""Where the output is not a terminal, a line is printed after each such share of the scans."""
SHOWN_FAULTS = 10
NOTICE_S = 1.0
"""Seconds after which a user wants to know what takes so long."""


@contextmanager
def output_folder(target: Path) -> Iterator[Path]:
    """Give a folder to write to; its files move to the target when the block ends without an error.

    After an error, folders that were made for it are removed again.

    Raises:
        LogError: The target cannot be written to.
    """
    made = [folder for folder in (target, *target.parents) if not folder.exists()]
    try:
        target.mkdir(parents=True, exist_ok=True)
        unfinished = Path(tempfile.mkdtemp(prefix=".unfinished-", dir=target))
    except OSError as error:
        raise LogError(f"{target}: cannot be written to: {error.strerror or error}") from error
    try:
        yield unfinished
        for file in sorted(unfinished.iterdir()):
            file.replace(target / file.name)
    except OSError as error:
        raise LogError(f"{target}: cannot be written to: {error.strerror or error}") from error
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)
        with suppress(OSError):  # the first that is not empty ends this
            for folder in made:
                folder.rmdir()


def compile_with_notice(stream: TextIO) -> None:
    """Compile the inner loops; say so if it takes long, as it does the first time."""
    notice = threading.Timer(
        NOTICE_S,
        print,
        ["compiling the inner loops; this is done once and takes some seconds"],
        {"file": stream},
    )
    notice.daemon = True
    notice.start()
    try:
        compile_kernels()
    finally:
        notice.cancel()


def write_report(path: Path, **values: float) -> None:
    """Write a ``report.json``; seconds are rounded to milliseconds."""
    rounded = {name: round(value, 3) for name, value in values.items()}
    path.write_text(json.dumps(rounded, indent=2) + "\n", encoding="utf-8")


def with_progress(records: Sequence[LaserRecord], stream: TextIO) -> Iterator[LaserRecord]:
    """Yield the records; print on the way how many were used, and how fast."""
    begin = time.perf_counter()
    is_terminal = stream.isatty()
    printed_at, printed = begin, 0
    for number, record in enumerate(records, 1):
        yield record
        now = time.perf_counter()
        is_last = number == len(records)
        due = now - printed_at >= REDRAW_S if is_terminal else number - printed >= SHARE * len(records)
        if due or is_last:
            rate = number / max(now - begin, 1e-6)
            end = "\r" if is_terminal and not is_last else "\n"
            print(f"{number} of {len(records)} scans, {rate:.0f} scans/s", end=end, file=stream, flush=True)
            printed_at, printed = now, number


def print_faults(faults: Iterable[str], stream: TextIO) -> None:
    """Print what of a log could not be used, the first ones in full."""
    texts = list(faults)
    for text in texts[:SHOWN_FAULTS]:
        print(text, file=stream)
    if len(texts) > SHOWN_FAULTS:
        print(f"... and {len(texts) - SHOWN_FAULTS} more", file=stream)
