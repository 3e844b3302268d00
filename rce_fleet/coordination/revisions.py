"""The number of a list of cells in a ``std_msgs/Int32MultiArray``.

The array's one dimension is labelled ``revision=17``. Programs that do not number lists may use
any other label, and may ignore it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Sequence

_MARK = "revision="


def numbered_array(cells: Sequence[int], revision: int) -> dict[str, Any]:
    """Return the fields of a ``std_msgs/Int32MultiArray`` for a numbered list of cells."""
    dimension = {"label": f"{_MARK}{revision}", "size": len(cells), "stride": len(cells)}
    return {"layout": {"dim": [dimension], "data_offset": 0}, "data": list(cells)}


def revision_of(labels: Sequence[str]) -> int | None:
    """Return the number in the labels of an array's dimensions; ``None`` without one."""
    for label in labels:
        text = label.removeprefix(_MARK)
        if text != label and text.isdecimal():
            return int(text)
    return None
