"""Draws a life cycle as SVG. Pure: table in, text out, the same text for the same table.

States are below each other. Transitions down leave a state on its right side, transitions up on its left. All
transitions to one state on one side join one line, at dots. States that may all follow each other, by the
same events, share a box. Events without a transition are not drawn.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from html import escape
from itertools import groupby
from typing import Any, TypeAlias

Table: TypeAlias = Mapping[Any, Mapping[Any, Any]]
"""State to event to the next state, all members of enums."""

SLOT, GAP, LANE, CORNER = 20, 22, 14, 6
CHARACTER = 6.6
"""Width of a character of a label; states are wider."""
COLOURS = ("#1565c0", "#c62828", "#2e7d32", "#6a1b9a", "#ef6c00", "#00838f", "#4e342e", "#ad1457")
"""One for the lines to each state, as far as they go."""
_HEAD = (
    '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}" height="{height}"'
    ' font-family="sans-serif" font-size="12">\n'
    '<rect width="{width}" height="{height}" rx="6" fill="#ffffff"/>'
)


def word(one: Enum) -> str:
    """Return the word for a state or an event."""
    return one.value if isinstance(one.value, str) else one.name.lower().replace("_", " ")


@dataclass
class Box:
    """States that are drawn as one, with their outgoing transitions.

    Attributes:
        states: The states.
        number: Its place from the top.
        down: Box number to the events that lead there, on the right side.
        up: The same for boxes above, on the left side.
        entered: The sides of incoming transitions: ``down`` means from above.
        top: Upper edge, pixels.
    """

    states: tuple[Enum, ...]
    number: int
    down: dict[int, list[str]] = field(default_factory=dict)
    up: dict[int, list[str]] = field(default_factory=dict)
    entered: set[str] = field(default_factory=set)
    top: int = 0

    @property
    def height(self) -> int:
        """Pixels."""
        slots = max(
            len(self.states), len(self.down) + ("down" in self.entered), len(self.up) + ("up" in self.entered)
        )
        return SLOT * slots + 10

    def slot(self, number: int) -> int:
        """Return the height of a slot's line; the first one is for incoming transitions."""
        return self.top + 5 + SLOT * number + SLOT // 2


def boxes_of(table: Table) -> list[Box]:
    """Return the boxes of a life cycle, with their transitions."""
    boxes = [Box(states, number) for number, states in enumerate(_groups(table))]
    place = {state: box for box in boxes for state in box.states}
    for box in boxes:
        for event, after in table[box.states[0]].items():
            target = place[after]
            if target is not box:
                side = "down" if target.number > box.number else "up"
                getattr(box, side).setdefault(target.number, []).append(word(event))
                target.entered.add(side)
    return boxes


def _groups(table: Table) -> Iterator[tuple[Enum, ...]]:
    """Yield the states that share a box: neighbours with one row, which leads to each of them."""
    for _, same in groupby(table, key=table.__getitem__):
        states = tuple(same)
        if set(states) <= set(table[states[0]].values()):
            yield states
        else:
            yield from ((state,) for state in states)


def draw(table: Table) -> str:
    """Return the picture of a life cycle."""
    boxes = boxes_of(table)
    top = 10
    for box in boxes:
        box.top = top
        top += box.height + GAP
    wide = max(len(word(state)) for state in table) * 8 + 24
    spaces = {side: _label_space(boxes, side) for side in ("up", "down")}
    left = spaces["up"] + LANE * sum("up" in box.entered for box in boxes) + 10
    width = left + wide + spaces["down"] + LANE * sum("down" in box.entered for box in boxes) + 10
    parts = [_HEAD.format(width=width, height=top - GAP + 10)]
    parts += _lines(boxes, "up", left, -1, spaces["up"])
    parts += _lines(boxes, "down", left + wide, 1, spaces["down"])
    for box in boxes:
        parts += _draw_box(box, left, wide, is_end=not table[box.states[0]])
    return "\n".join([*parts, "</svg>"]) + "\n"


def _label_space(boxes: Sequence[Box], side: str) -> int:
    labels = [_label(events) for box in boxes for events in getattr(box, side).values()]
    return round(max((len(label) for label in labels), default=0) * CHARACTER) + 16 if labels else 0


def _label(events: Sequence[str]) -> str:
    return ", ".join(events)


def _lines(boxes: Sequence[Box], side: str, edge: int, sign: int, space: int) -> list[str]:
    """Draw the transitions to each state on one side; the lines of the nearest targets are the inner ones."""
    targets = [box for box in boxes if side in box.entered]
    parts = []
    for number, target in enumerate(targets if sign > 0 else reversed(targets)):
        lane = edge + sign * (space + LANE * number + LANE // 2)
        colour = COLOURS[target.number % len(COLOURS)]
        sources = [box for box in boxes if target.number in getattr(box, side)]
        sources = sources if sign > 0 else sources[::-1]  # the farthest first
        enter = target.slot(0)
        for place, source in enumerate(sources):
            leads = getattr(source, side)
            y = source.slot(list(leads).index(target.number) + (side in source.entered))
            bend = CORNER if enter > y else -CORNER
            label = escape(_label(leads[target.number]))
            place_of_label = (
                f'x="{edge + sign * 8}" y="{y - 4}" text-anchor="{"start" if sign > 0 else "end"}"'
            )
            if place == 0:
                path = (
                    f"M{edge},{y} H{lane - sign * CORNER} Q{lane},{y} {lane},{y + bend} V{enter - bend}"
                    f" Q{lane},{enter} {lane - sign * CORNER},{enter} H{edge + sign * 6}"
                )
            else:
                path = f"M{edge},{y} H{lane}"
                parts.append(f'<circle cx="{lane}" cy="{y}" r="3" fill="{colour}"/>')
            parts.append(f'<path d="{path}" fill="none" stroke="{colour}" stroke-width="1.4"/>')
            parts.append(f'<text {place_of_label} fill="{colour}">{label}</text>')
        tip = f"{edge},{enter} {edge + sign * 8},{enter - 4} {edge + sign * 8},{enter + 4}"
        parts.append(f'<polygon points="{tip}" fill="{colour}"/>')
    return parts


def _draw_box(box: Box, left: int, wide: int, *, is_end: bool) -> list[str]:
    middle = box.top + box.height / 2 - SLOT * (len(box.states) - 1) / 2
    shape = f'<rect x="{left}" y="{box.top}" width="{wide}" height="{box.height}" rx="5" stroke="#455a64"'
    parts = [f'{shape} fill="{"#cfd8dc" if is_end else "#eceff1"}" stroke-width="{2 if is_end else 1}"/>']
    for number, state in enumerate(box.states):
        parts.append(
            f'<text x="{left + wide // 2}" y="{middle + SLOT * number + 4:g}" text-anchor="middle"'
            f' font-weight="bold" fill="#263238">{escape(word(state))}</text>'
        )
    return parts
