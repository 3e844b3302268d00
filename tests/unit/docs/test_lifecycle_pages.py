"""The page of life cycles, and its pictures, say what the tables in the code say."""

from __future__ import annotations

import re
from enum import Enum
from pathlib import Path
from xml.etree import ElementTree as ET

import pytest

from rce.lifecycle import LifeCycle
from rce_fleet.coordination.move_client import GoalState
from tools import lifecycles
from tools.lifecycles import CYCLES, Cycle
from tools.state_diagram import boxes_of, draw, word

ROOT = Path(__file__).parents[3]
PAGE = (ROOT / "docs/reference/lifecycles.md").read_text()
SVG = "{http://www.w3.org/2000/svg}"


class Door(Enum):
    OPEN = "open"
    """It is open."""
    AJAR = "ajar"
    """It is nearly closed."""
    CLOSED = "closed"
    """It is closed."""
    GONE = "gone"
    """It is an end."""


class Push(Enum):
    PUSH = "push"
    """It is pushed."""
    PULL = "pull"
    """It is pulled."""
    BREAK = "break"
    """It breaks."""


TABLE = {
    Door.OPEN: {Push.PUSH: Door.AJAR, Push.PULL: Door.OPEN},
    Door.AJAR: {Push.PUSH: Door.CLOSED, Push.PULL: Door.OPEN, Push.BREAK: Door.GONE},
    Door.CLOSED: {Push.PULL: Door.AJAR, Push.BREAK: Door.GONE},
    Door.GONE: {},
}


def texts(svg: str) -> list[str]:
    return [element.text or "" for element in ET.fromstring(svg).iter(f"{SVG}text")]


def rows(section: str) -> dict[str, str]:
    """State to what the page's table says of its events."""
    return dict(re.findall(r"^\| \*\*([^*]+)\*\* \| [^|]+ \| ([^|]+) \|$", section, re.MULTILINE))


@pytest.mark.parametrize("cycle", CYCLES, ids=lambda cycle: cycle.name)
def test_the_page_shows_the_table_as_it_is(cycle: Cycle) -> None:
    """A table that changes fails this until ``make reference`` was run."""
    assert "\n".join(lifecycles.section(cycle)) in PAGE
    section = PAGE.partition(f"\n## {cycle.title}\n")[2].partition("\n## ")[0]
    wanted = {
        word(state): ", ".join(f"{word(event)} → {word(after)}" for event, after in row.items()) or "an end"
        for state, row in cycle.life.table.items()
    }
    assert rows(section) == wanted


@pytest.mark.parametrize("cycle", CYCLES, ids=lambda cycle: cycle.name)
def test_the_picture_shows_the_table_as_it_is(cycle: Cycle) -> None:
    svg = (ROOT / lifecycles.IMAGES / f"{cycle.name}.svg").read_text()
    assert svg == draw(cycle.life.table)
    shown = texts(svg)
    boxes = boxes_of(cycle.life.table)
    place = {state: box.number for box in boxes for state in box.states}
    assert {word(state) for state in cycle.life.table} <= set(shown)
    for state, row in cycle.life.table.items():
        for event, after in row.items():
            if place[state] != place[after]:
                assert any(word(event) in label.split(", ") for label in shown), (state, event)


def test_every_life_cycle_of_the_code_has_a_section() -> None:
    found = set()
    for package in ("rce", "rce_client", "rce_container", "rce_fleet", "rce_master", "rce_robot"):
        for file in (ROOT / package).rglob("*.py"):
            name = ".".join(file.relative_to(ROOT).with_suffix("").parts)
            names = re.findall(r"^(\w+)(?:: .*)? = LifeCycle\(", file.read_text(), re.MULTILINE)
            found |= {f"{name}.{each}" for each in names}
    shown = {cycle.life for cycle in CYCLES}
    missing = []
    for path in found:
        module, _, name = path.rpartition(".")
        life = getattr(__import__(module, fromlist=[name]), name)
        assert isinstance(life, LifeCycle)
        if life not in shown:
            missing.append(path)
    assert found
    assert missing == []


def test_a_table_that_changes_changes_page_and_picture() -> None:
    cycle = Cycle("Door", "door", "A door.", LifeCycle("door", TABLE))
    other = {**TABLE, Door.CLOSED: {Push.PUSH: Door.AJAR, Push.BREAK: Door.GONE}}
    changed = cycle._replace(life=LifeCycle("door", other))
    assert list(lifecycles.section(cycle)) != list(lifecycles.section(changed))
    assert draw(cycle.life.table) != draw(changed.life.table)


def test_lines_lead_to_states_on_their_side() -> None:
    opened, ajar, closed, gone = boxes_of(TABLE)
    assert (opened.down, opened.up) == ({1: ["push"]}, {})
    assert (ajar.down, ajar.up) == ({2: ["push"], 3: ["break"]}, {0: ["pull"]})
    assert (closed.down, closed.up) == ({3: ["break"]}, {1: ["pull"]})
    assert (gone.down, gone.up, gone.entered) == ({}, {}, {"down"})


def test_neighbours_that_follow_each_other_share_a_box() -> None:
    row = {Push.PUSH: Door.AJAR, Push.PULL: Door.CLOSED, Push.BREAK: Door.GONE}
    boxes = boxes_of({Door.OPEN: {Push.PUSH: Door.AJAR}, Door.AJAR: row, Door.CLOSED: row, Door.GONE: {}})
    assert [box.states for box in boxes] == [(Door.OPEN,), (Door.AJAR, Door.CLOSED), (Door.GONE,)]
    assert boxes[1].down == {2: ["break"]}


def test_a_member_without_docstring_is_refused() -> None:
    with pytest.raises(LookupError, match="has no docstring"):
        lifecycles.meaning(GoalState.PENDING)
