"""Log records on the wire."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rce.ros.logrecord import KIND, MD5SUM, Level, LogRecord, read_record
from rce.ros.types import Time, TypeRegistry

LOG = TypeRegistry().message(KIND)
WORD = st.integers(0, 2**32 - 1)
TEXT = st.text(max_size=20)
RECORDS = st.builds(
    LogRecord,
    secs=WORD,
    nsecs=st.integers(0, 999_999_999),
    level=st.sampled_from(Level),
    name=TEXT,
    text=TEXT,
    file=TEXT,
    function=TEXT,
    line=WORD,
    topics=st.lists(TEXT, max_size=4).map(tuple),
)


def payload(record: LogRecord) -> bytes:
    return LOG.serialize(
        LOG.new(
            header={"stamp": Time(record.secs, record.nsecs), "frame_id": "frame"},
            level=int(record.level),
            name=record.name,
            msg=record.text,
            file=record.file,
            function=record.function,
            line=record.line,
            topics=list(record.topics),
        )
    )


def test_it_is_the_type_that_ros_knows() -> None:
    assert LOG.md5sum == MD5SUM


@given(RECORDS)
def test_reads_what_the_codec_writes(record: LogRecord) -> None:
    assert read_record(payload(record)) == record


@given(RECORDS, st.data())
def test_a_record_that_is_cut_off_is_refused(record: LogRecord, data: st.DataObject) -> None:
    whole = payload(record)
    with pytest.raises(ValueError, match="no log record"):
        read_record(whole[: data.draw(st.integers(0, len(whole) - 1))])


def test_a_record_that_claims_too_much_is_refused() -> None:
    empty = payload(LogRecord(0, 0, 1, "", "", "", "", 0, ()))
    with pytest.raises(ValueError, match="4294967295 topics"):
        read_record(empty[:-4] + b"\xff" * 4)


def test_it_looks_as_in_ros() -> None:
    record = LogRecord(12, 802947044, 4, "/talker", "hello\nthere", "/x/ro.py", "main", 11, ("/a", "/b"))
    assert record.in_file() == ("12.802947044 WARN /talker [/x/ro.py:11(main)] [topics: /a, /b] hello\nthere")
    assert record.on_console() == "[WARN] [12.802947]: hello\nthere"
    assert record._replace(level=3).level_name == "3"
