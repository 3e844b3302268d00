"""Settings that are handed from program to program."""

from __future__ import annotations

import json

import pytest

from rce.config.loading import handed_over

DOCUMENT = json.dumps({"dev": True, "master_host": "192.0.2.1", "master": {"http_port": 9100}})


def test_settings_alone_are_read() -> None:
    settings = handed_over(["--settings", DOCUMENT], master=True)
    assert settings is not None
    assert settings.dev
    assert settings.master_host == "192.0.2.1"
    assert settings.master.http_port == 9100


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        ["--help"],
        ["--settings"],
        ["--settings", DOCUMENT, "--verbose"],
        ["--settings", "{"],
        ["--settings", "[]"],
        ["--settings", json.dumps({"master": {"http_port": "many"}})],
    ],
)
def test_other_command_lines_are_left_to_their_reader(arguments: list[str]) -> None:
    assert handed_over(arguments) is None


def test_settings_without_needed_master_are_left_to_the_reader() -> None:
    assert handed_over(["--settings", "{}"], master=True) is None
    assert handed_over(["--settings", "{}"]) is not None
