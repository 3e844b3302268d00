"""How the number of a list of cells travels in a ``std_msgs/Int32MultiArray``.

The array's one dimension is labelled ``revision=17``. Who does not number lists leaves the label as it
likes, and who does not care need not look at it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Sequence

_MARK = "revision="


def numbered_array(cells: Sequence[int], revision: int) -> dict[str, Any]:
    """The fields of a ``std_msgs/Int32MultiArray`` that holds a numbered list of cells."""
    dimension = {"label": f"{_MARK}{revision}", "size": len(cells), "stride": len(cells)}
    return {"layout": {"dim": [dimension], "data_offset": 0}, "data": list(cells)}


def revision_of(labels: Sequence[str]) -> int | None:
    """The number in the labels of an array's dimensions; ``None`` if there is none."""
    for label in labels:
        text = label.removeprefix(_MARK)
        if text != label and text.isdecimal():
            return int(text)
    return None
