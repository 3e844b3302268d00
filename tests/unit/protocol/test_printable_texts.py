"""Texts of strangers on terminals."""

from __future__ import annotations

import pytest

from rce.printable import REPLACEMENT, for_terminal, one_line

CLIPBOARD = "\x1b]52;c;cm0gLXJm\x07"
CLEAR = "\x1b[2J\x1b[H"


@pytest.mark.parametrize("text", ["plain", "größer 世界 🤖", ""])
def test_ordinary_text_stays(text: str) -> None:
    assert one_line(text) == for_terminal(text) == text


@pytest.mark.parametrize(
    "code", [CLIPBOARD, CLEAR, "\x9b2J", "\x1bc", "\b\b\b", "\x00", "\u202etxt.exe", "a\rb"]
)
def test_a_terminal_is_told_nothing(code: str) -> None:
    for clean in (one_line(code), for_terminal(code)):
        assert REPLACEMENT in clean
        assert not set(clean) & {"\x1b", "\x9b", "\x07", "\b", "\0", "\r", "\u202e"}


def test_logs_keep_lines_and_colours() -> None:
    text = "\x1b[31merror\x1b[0m\there\r\nnext\n"
    assert for_terminal(text) == text


def test_what_is_one_line_stays_one() -> None:
    assert one_line("fine\nadmin logged in") == f"fine{REPLACEMENT}admin logged in"
    assert one_line("\x1b[31mred") == f"{REPLACEMENT}[31mred"
