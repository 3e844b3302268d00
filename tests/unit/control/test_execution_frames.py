"""Frames of commands in containers, and messages of later releases."""

from __future__ import annotations

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rce.control.execution import (
    MAX_ARGUMENTS,
    MAX_DATA,
    MIN_WINDOW,
    Command,
    Frame,
    Part,
    amount_frame,
    decode,
    ended_frame,
    path_of,
    read_amount,
    read_command,
    read_ended,
    read_size,
    run_of,
    size_frame,
)
from rce.control.messages import Execute, Welcome, decode_to_master, decode_to_task_set, encode
from rce.control.tags import Unknown
from rce_container.environment import messages as m


@given(st.sampled_from(Part), st.binary(max_size=MAX_DATA))
def test_frames_are_read_as_written(part: Part, data: bytes) -> None:
    assert decode(Frame(part, data).encode()) == (part, data)


@pytest.mark.parametrize("frame", [b"", b"?", b"O", b"o" + bytes(MAX_DATA + 1)])
def test_wrong_frames_are_refused(frame: bytes) -> None:
    with pytest.raises(ValueError, match=r"frame|valid Part"):
        decode(frame)


@given(st.integers(0, 100_000), st.integers(0, 65535))
def test_sizes_fit_their_frame(rows: int, columns: int) -> None:
    assert read_size(size_frame(rows, columns).data) == (min(rows, 65535), columns)
    with pytest.raises(ValueError, match="4 bytes"):
        read_size(b"\0")


@given(st.integers(0, 2**32 - 1))
def test_amounts_are_read_as_written(amount: int) -> None:
    assert read_amount(amount_frame(Part.TAKEN, amount).data) == amount
    with pytest.raises(ValueError, match="4 bytes"):
        read_amount(b"\0" * 5)


def test_the_last_frame_holds_code_and_reason() -> None:
    assert read_ended(ended_frame(137, "killed").data) == read_ended(b'{"code":137,"reason":"killed"}')
    with pytest.raises(msgspec.ValidationError):
        read_ended(b"{}")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('{"argv": ["a\\u0000b"]}', "NUL"),
        (f'{{"window": {MIN_WINDOW - 1}}}', "window"),
        ('{"window": -1}', "window"),
        ('{"rows": 70000}', "70000 rows"),
        ('{"columns": -1}', "-1 columns"),
        ('{"variables": {"A=B": "c"}}', "'='"),
        ('{"variables": {"": "c"}}', "'='"),
        ('{"argv": ' + str(["x"] * (MAX_ARGUMENTS + 1)).replace("'", '"') + "}", "1025 arguments"),
        ('{"argv": ["' + "x" * (128 << 10) + '"]}', "bytes"),
    ],
)
def test_bad_commands_are_refused_with_the_reason(text: str, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        read_command(text)


def test_a_command_needs_no_more_than_nothing() -> None:
    assert read_command("{}") == Command()
    with pytest.raises(msgspec.ValidationError, match=r"argv\[0\]"):
        read_command('{"argv": [1]}')


def test_paths_name_runs() -> None:
    run = "0123456789abcdef" * 2
    assert run_of(path_of(run)) == run
    assert run_of("/exec/" + "g" * 32) is None
    assert run_of("/exec/" + run + "/") is None
    assert run_of("/") is None


def test_messages_of_a_later_release_are_told_from_wrong_ones() -> None:
    later = '{"t":"Teleport","where":"mars"}'
    for read in (decode_to_master, decode_to_task_set, m.decode_to_environment, m.decode_to_manager):
        assert read(later) == Unknown("Teleport")
        with pytest.raises(msgspec.ValidationError):
            read('{"where":"mars"}')
    with pytest.raises(msgspec.ValidationError, match="master"):
        decode_to_task_set('{"t":"Welcome","version":1}')
    with pytest.raises(msgspec.ValidationError, match="spec"):
        m.decode_to_environment('{"t":"Apply"}')


def test_fields_of_a_later_release_are_passed_over() -> None:
    assert decode_to_task_set('{"t":"Welcome","version":1,"master":"m","mood":"good"}') == Welcome(
        version=1, master="m"
    )
    order = Execute(id="u/c", run="0" * 32, command=Command(argv=("ls",)))
    assert decode_to_task_set(encode(order)) == order
