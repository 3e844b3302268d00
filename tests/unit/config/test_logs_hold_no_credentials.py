from __future__ import annotations

import logging
import sys

import pytest

from rce.config.logs import RedactingFormatter, redact

DIGEST = "0123456789abcdef" * 4
TOKEN = "rce_" + "Ab-_" * 11


@pytest.mark.parametrize(
    "text",
    [
        f"GET /?userID=u&robotID=r&password={DIGEST} HTTP/1.1",
        f"Authorization: Bearer {TOKEN}",
        f"headers {{'authorization': 'bearer {DIGEST}'}}",
        f"the token {TOKEN} is unknown",
        f"http://h/?token={TOKEN}#x",
    ],
)
def test_credentials_are_redacted(text: str) -> None:
    cleaned = redact(text)
    assert DIGEST not in cleaned
    assert TOKEN not in cleaned
    assert "***" in cleaned


@pytest.mark.parametrize("text", ["a bearer token is needed", "the password was changed", f"hash {DIGEST}"])
def test_other_text_stays(text: str) -> None:
    assert redact(text) == text


def fail(url: str) -> None:
    raise ValueError(f"cannot open {url}")


def test_tracebacks_are_redacted_too() -> None:
    try:
        fail(f"ws://h/?password={DIGEST}")
    except ValueError:
        record = logging.LogRecord("x", logging.ERROR, "f", 1, "failed", (), sys.exc_info())
    text = RedactingFormatter("%(message)s").format(record)
    assert "Traceback" in text
    assert DIGEST not in text
