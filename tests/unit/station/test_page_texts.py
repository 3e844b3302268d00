"""All texts of the page are in one place: each that is shown is there, and each that is there is shown."""

from __future__ import annotations

import re
from pathlib import Path

import rce_fleet.station

STATIC = Path(rce_fleet.station.__file__).parent / "static"
SOURCES = {
    file.name: file.read_text(encoding="utf-8")
    for pattern in ("*.js", "*.html")
    for file in STATIC.glob(pattern)
}
KEYS = set(re.findall(r'^  "?([\w.]+)"?: "', SOURCES.pop("texts.js"), re.MULTILINE))
SHOWN = re.compile(r'(?:\bt\(|data-text=|data-label=)"([\w.]+)"')
USED = {key for text in SOURCES.values() for key in SHOWN.findall(text)}
MADE = {stem for text in SOURCES.values() for stem in re.findall(r"\bt\(`([\w.]+\.)\$\{", text)}
"""Beginnings of keys that are put together: ``t(`task.${state}`)``."""


def test_each_text_that_is_shown_exists() -> None:
    assert len(KEYS) > 100
    assert KEYS >= USED
    assert all(any(key.startswith(stem) for key in KEYS) for stem in MADE)


def test_each_text_is_shown() -> None:
    everything = "".join(SOURCES.values())
    unused = {key for key in KEYS - USED if f'"{key}"' not in everything}
    assert {key for key in unused if not any(key.startswith(stem) for stem in MADE)} == set()


def test_no_program_has_words_of_its_own() -> None:
    """Neither as a text of an element nor in its label."""
    places = r'(?:textContent = |setAttribute\("aria-label", |\.title = |element\("\w+", )'
    own = re.compile(places + r'["`][A-Za-z][\w ]*["`]')
    assert [(name, found) for name, text in SOURCES.items() for found in own.findall(text)] == []
