"""Logs: what environments write and managers read."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rce_container import logs
from rce_container.environment.logs.files import SEGMENTS, LogWriter, segments
from rce_container.logs import read_log


def everything(folder: Path, name: str, limit: int = 7) -> str:
    text, offset = "", 0
    while True:
        chunk = read_log(folder, name, offset, limit)
        if chunk.offset == offset:
            return text
        text, offset = text + chunk.text, chunk.offset


def test_reads_what_was_written_in_pieces(tmp_path: Path) -> None:
    log = LogWriter(tmp_path, "node")
    log.write("grüße\n".encode() * 3)
    log.write(b"end")
    assert everything(tmp_path, "node", 4) == "grüße\n" * 3 + "end"
    log.close()


@given(text=st.text(alphabet=st.characters(codec="utf-8"), max_size=60), limit=st.integers(1, 9))
def test_characters_are_never_cut(tmp_path_factory: pytest.TempPathFactory, text: str, limit: int) -> None:
    folder = tmp_path_factory.mktemp("logs")
    log = LogWriter(folder, "n")
    log.write(text.encode())
    log.close()
    assert everything(folder, "n", max(4, limit)) == text


def test_its_size_is_bounded_and_offsets_stay_valid(tmp_path: Path) -> None:
    log = LogWriter(tmp_path, "n", segment_bytes=100)
    for number in range(100):
        log.write(b"line %04d\n" % number)
    log.close()
    kept = segments(tmp_path, "n")
    assert len(kept) == SEGMENTS
    assert sum(path.stat().st_size for _, path in kept) <= 220
    chunk = read_log(tmp_path, "n", 990, 1000)
    assert (chunk.text, chunk.offset) == ("line 0099\n", 1000)
    oldest = read_log(tmp_path, "n", 0, 10)
    assert oldest.text.startswith("line 00")
    assert oldest.offset > 700, "what is not kept is passed over"
    assert read_log(tmp_path, "n", -20, 1000).text == "line 0098\nline 0099\n"
    assert read_log(tmp_path, "n", 5000, 10).offset == 1000


@pytest.mark.parametrize("gone_before", ["_size", "_read"])
def test_segment_that_is_removed_while_read_is_left_out(
    gone_before: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The environment may remove the oldest one at any moment."""
    log = LogWriter(tmp_path, "n", segment_bytes=10)
    log.write(b"line 0000\n")
    log.write(b"line 0001\n")
    log.close()
    oldest = segments(tmp_path, "n")[0][1]
    step = getattr(logs, gone_before)

    def rotate_then(path: Path, *arguments: int) -> object:
        oldest.unlink(missing_ok=True)
        return step(path, *arguments)

    monkeypatch.setattr(logs, gone_before, rotate_then)
    chunk = read_log(tmp_path, "n", 0, 1000)
    assert (chunk.text, chunk.offset) == ("line 0001\n", 20)


def test_a_second_writer_goes_on(tmp_path: Path) -> None:
    for _ in range(2):
        log = LogWriter(tmp_path, "n", segment_bytes=4)
        log.write(b"abcde")
        log.close()
    assert read_log(tmp_path, "n", 0, 100).text == "abcdeabcde"


def test_mirrors_lead_to_the_newest_segment(tmp_path: Path) -> None:
    mirror = os.open(os.devnull, os.O_WRONLY)
    log = LogWriter(tmp_path, "n", segment_bytes=3, mirror=(mirror,))
    log.write(b"abc")
    log.write(b"def")
    os.write(mirror, b"!")
    os.close(mirror)
    log.close()
    assert segments(tmp_path, "n")[-1][1].read_bytes() == b"def!"


def test_tags_that_begin_alike_are_told_apart(tmp_path: Path) -> None:
    for name in ("a", "ab"):
        log = LogWriter(tmp_path, name)
        log.write(name.encode())
        log.close()
    assert read_log(tmp_path, "a", 0, 9).text == "a"


def test_there_is_none(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="there is no log of n"):
        read_log(tmp_path, "n", 0, 10)


@pytest.mark.parametrize("kind", ["symlink", "fifo"])
def test_a_node_cannot_make_the_manager_read_something_else(tmp_path: Path, kind: str) -> None:
    secret = tmp_path / "secret"
    secret.write_text("secret")
    target = tmp_path / "n.000000000000.log"
    if kind == "symlink":
        target.symlink_to(secret)
    else:
        os.mkfifo(target)
    assert read_log(tmp_path, "n", 0, 10).text == ""
