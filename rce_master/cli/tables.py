"""Tables of the commands. What users and their nodes wrote is printed as it is, and never interpreted."""

from __future__ import annotations

from rich.table import Table
from rich.text import Text

from rce.printable import one_line

_COLOURS = {
    "running": "green",
    "connected": "green",
    "absent": "yellow",
    "starting": "yellow",
    "placed": "yellow",
    "requested": "yellow",
    "stopping": "yellow",
    "waiting": "yellow",
    "draining": "yellow",
    "degraded": "yellow",
    "stopped": "yellow",
    "stuck": "red",
    "failed": "red",
    "lost": "red",
    "away": "red",
}


class TextTable(Table):
    """A table without borders whose cells are plain text: brackets are not markup.

    Args:
        headings: Its columns.
        show_header: Whether the headings are printed.
    """

    def __init__(self, *headings: str, show_header: bool = True) -> None:
        super().__init__(*headings, box=None, show_header=show_header)

    def add(self, *cells: str | Text) -> None:
        """Add a row.

        Args:
            cells: Texts of any origin; a :class:`~rich.text.Text` has colours.
        """
        self.add_row(*(_lines(cell) if isinstance(cell, str) else cell for cell in cells))


def plain(text: str, style: str = "") -> Text:
    """Return a text of any origin as one line in one style, without what a terminal would interpret."""
    return Text(one_line(text), style)


def coloured(state: str) -> Text:
    """Return a state in a colour that shows its severity."""
    return plain(state, _COLOURS.get(state, "default"))


def yes_or_no(value: bool) -> Text:
    """Return a value as a word in a colour."""
    return plain("yes", "green") if value else plain("no", "yellow")


def _lines(text: str) -> Text:
    """Return a cell; its lines stay in their column, so they cannot imitate other cells."""
    return Text("\n").join(plain(line) for line in text.splitlines())
