"""The loops of :mod:`rce_fleet.tasks.matching`: pairs of rows and columns with the smallest sum of costs.

Each row has a *shortlist*: the columns that cost it least, with the least reduced cost of all others beside
it. Prices of columns only fall, so that reduced costs only grow: this bound holds until the shortlist is made
anew. As long as a search for a path stays below the bounds of the rows that it passes, it reads shortlists of
some hundred bytes and not rows of the matrix, which are not in the processor's caches.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from rce_fleet.compiled import helper, kernel

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Ints = NDArray[np.int64]
    Floats = NDArray[np.float64]

SHORTLIST = 128
"""Most columns of a shortlist."""
_SAMPLE = 24
"""So many reduced costs are looked at to choose the largest one of a shortlist: two of them are in it."""
_PASSES = 4
"""How often rows without a column bid for one, before a search for each that is left."""
_DENSE_FROM = 4
"""Shortlists are not used any more when this share of the rows that searches passed was read as a whole."""


def _match_numpy(costs: Floats) -> Ints:
    from scipy.optimize import linear_sum_assignment  # long to load, needed only where nothing is compiled

    rows, columns = linear_sum_assignment(costs)
    found = np.empty(len(costs), np.int64)
    found[rows] = columns
    return found


@helper
def _reduce_columns(costs: Floats, prices: Floats, column_of: Ints, row_of: Ints) -> None:
    """Make each column's least cost its price; the row with it gets the column, if it has none yet."""
    rows, columns = costs.shape
    cheapest = np.zeros(columns, np.int64)
    prices[:] = costs[0]
    for row in range(1, rows):
        line = costs[row]
        for column in range(columns):
            here, now = line[column], prices[column]
            cheapest[column] = row if here < now else cheapest[column]
            prices[column] = here if here < now else now
    for column in range(columns - 1, -1, -1):
        row = cheapest[column]
        if column_of[row] < 0:
            column_of[row] = column
            row_of[column] = row


@helper
def _shorten(reduced: Floats, kept: Ints, count: int, least: float, greatest: float) -> int:
    """Keep the columns of the smallest reduced costs, until they fit into a shortlist; return how many."""
    while count > SHORTLIST:
        middle = least + (greatest - least) / 2
        if middle >= greatest or middle <= least:
            middle = least
        fewer = 0
        for place in range(count):
            column = kept[place]
            kept[fewer] = column
            fewer += reduced[column] <= middle
        count = fewer
        if middle == least:
            return min(count, SHORTLIST)
        greatest = middle
    return count


@helper
def _least(values: Floats) -> float:
    """Return the least number: of four parts side by side, since a processor does not wait for each then."""
    a = b = c = d = np.inf
    whole = len(values) - len(values) % 4
    for place in range(0, whole, 4):
        a = values[place] if values[place] < a else a
        b = values[place + 1] if values[place + 1] < b else b
        c = values[place + 2] if values[place + 2] < c else c
        d = values[place + 3] if values[place + 3] < d else d
    for place in range(whole, len(values)):
        a = values[place] if values[place] < a else a
    return min(a, b, c, d)


@helper
def _make_shortlist(
    line: Floats, prices: Floats, reduced: Floats, kept: Ints, near: NDArray[np.int32], near_costs: Floats
) -> tuple[int, float]:
    """Make a row's shortlist; return its length, and the least reduced cost of all other columns.

    Args:
        line: The row's costs, shape (columns,).
        prices: Prices of the columns.
        reduced: The row's reduced costs; written.
        kept: Written.
        near: The columns of the shortlist, shape (SHORTLIST,); written.
        near_costs: Their costs; written.
    """
    columns = len(line)
    for column in range(columns):
        reduced[column] = line[column] - prices[column]
    if columns <= SHORTLIST:
        for column in range(columns):
            near[column] = column
            near_costs[column] = line[column]
        return columns, np.inf
    # The second smallest of a sample bounds the shortlist: at least two columns are in it.
    first = second = np.inf
    for place in range(_SAMPLE):
        value = reduced[place * columns // _SAMPLE]
        if value < first:
            first, second = value, first
        elif value < second:
            second = value
    count = 0
    for column in range(columns):
        kept[count] = column
        count += reduced[column] <= second
    if count > SHORTLIST:
        least = second
        for place in range(count):
            least = min(least, reduced[kept[place]])
        count = _shorten(reduced, kept, count, least, second)
    for place in range(count):
        column = kept[place]
        near[place] = column
        near_costs[place] = line[column]
        reduced[column] = np.inf
    return count, _least(reduced)


@helper
def _bid(
    row: int,
    costs: Floats,
    prices: Floats,
    near: NDArray[np.int32],
    near_costs: Floats,
    lengths: Ints,
    rests: Floats,
    reduced: Floats,
    kept: Ints,
) -> tuple[float, float, int, int]:
    """Return the two least reduced costs of a row, and their columns; -1: the second one's is not known."""
    for attempt in range(2):
        first = second = np.inf
        best = other = -1
        for place in range(lengths[row]):
            column = near[row, place]
            value = near_costs[row, place] - prices[column]
            if value < first:
                first, second = value, first
                best, other = column, best
            elif value < second:
                second = value
                other = column
        if second <= rests[row]:
            return first, second, best, other
        if attempt == 0:
            lengths[row], rests[row] = _make_shortlist(
                costs[row], prices, reduced, kept, near[row], near_costs[row]
            )
    return first, rests[row], best, -1


@helper
def _lift(keys: Floats, items: Ints, places: Ints, place: int, key: float, item: int) -> None:
    """Put an item with a key into a binary heap, at this place or above it."""
    while place > 0 and keys[(place - 1) // 2] > key:
        keys[place] = keys[(place - 1) // 2]
        items[place] = items[(place - 1) // 2]
        places[items[place]] = place
        place = (place - 1) // 2
    keys[place] = key
    items[place] = item
    places[item] = place


@helper
def _take_first(keys: Floats, items: Ints, places: Ints, count: int) -> None:
    """Take the item with the least key out of a binary heap of ``count`` items."""
    places[items[0]] = -1
    count -= 1
    if count == 0:
        return
    key, item = keys[count], items[count]
    place = 0
    while 2 * place + 1 < count:
        child = 2 * place + 1
        if child + 1 < count and keys[child + 1] < keys[child]:
            child += 1
        if keys[child] >= key:
            break
        keys[place] = keys[child]
        items[place] = items[child]
        places[items[place]] = place
        place = child
    keys[place] = key
    items[place] = item
    places[item] = place


@kernel("int64[::1](float64[:, ::1])", numpy=_match_numpy)
def match_rows(costs: Floats) -> Ints:
    """Give each row a column of its own, with the smallest sum of costs.

    Columns lower their prices until rows want different ones, and each row that is left gets a column along
    a shortest augmenting path (Jonker and Volgenant, "A shortest augmenting path algorithm for dense and
    sparse linear assignment problems", 1987).

    Args:
        costs: Finite numbers, shape (rows, columns), at least as many columns as rows.

    Returns:
        The column of each row, shape (rows,). Of several with the same sum, the two forms can return
        different ones.
    """
    rows, columns = costs.shape
    column_of = np.full(rows, -1, np.int64)
    row_of = np.full(columns, -1, np.int64)
    prices = np.zeros(columns)
    if rows == columns and rows > 0:
        _reduce_columns(costs, prices, column_of, row_of)
    near = np.empty((rows, SHORTLIST), np.int32)
    near_costs = np.empty((rows, SHORTLIST))
    lengths = np.zeros(rows, np.int64)
    rests = np.full(rows, -np.inf)
    reduced = np.empty(columns)
    kept = np.empty(columns, np.int64)

    # Rows bid: the column that suits a row best lowers its price until another one suits as well.
    free = np.empty(rows, np.int64)
    left = 0
    for row in range(rows):
        if column_of[row] < 0:
            free[left] = row
            left += 1
    for _ in range(_PASSES):
        waiting, place, left, bids = left, 0, 0, 0
        while place < waiting:
            row = free[place]
            place += 1
            bids += 1
            first, second, column, other = _bid(
                row, costs, prices, near, near_costs, lengths, rests, reduced, kept
            )
            lowered = prices[column] - (second - first)
            is_lower = lowered < prices[column] and second < np.inf
            if is_lower:
                prices[column] = lowered
            elif row_of[column] >= 0 and other >= 0:
                column = other
            owner = row_of[column]
            column_of[row] = column
            row_of[column] = row
            if owner >= 0:
                column_of[owner] = -1
                if is_lower and bids < 2 * rows:
                    place -= 1
                    free[place] = owner
                else:
                    free[left] = owner
                    left += 1

    # A shortest path from each row that is left to a free column, through pairs that are changed along it.
    # Waiting are columns, by their labels, and rows (their number after the columns'), by the least label
    # that a column beside their shortlist can have.
    paid = np.zeros(rows)
    for row in range(rows):
        if column_of[row] >= 0:
            paid[row] = costs[row, column_of[row]]
    offsets = np.zeros(rows)
    labels = np.full(columns, np.inf)
    came_from = np.empty(columns, np.int64)
    is_closed = np.zeros(columns, np.bool_)
    seen = np.empty(columns, np.int64)
    closed = np.empty(columns, np.int64)
    tied = np.empty(columns, np.int64)
    keys = np.empty(columns + rows)
    items = np.empty(columns + rows, np.int64)
    places = np.full(columns + rows, -1, np.int64)
    relaxed, whole = 0, 0
    for turn in range(left):
        row = free[turn]
        offsets[row], distance = 0.0, -np.inf
        end, shortest = -1, np.inf
        is_dense = whole * _DENSE_FROM > relaxed
        is_whole = is_dense
        heap = tied_count = taken = seen_count = closed_count = 0
        while True:
            offset = offsets[row]
            if not is_whole and rests[row] - offset < distance:
                lengths[row], rests[row] = _make_shortlist(
                    costs[row], prices, reduced, kept, near[row], near_costs[row]
                )
            relaxed += not is_dense
            whole += is_whole and not is_dense
            for place in range(columns if is_whole else lengths[row]):
                column = place if is_whole else near[row, place]
                cost = costs[row, column] if is_whole else near_costs[row, place]
                label = cost - prices[column] - offset
                label = label if label > distance else distance
                if label >= labels[column] or label >= shortest or is_closed[column]:
                    continue
                if labels[column] == np.inf:
                    seen[seen_count] = column
                    seen_count += 1
                labels[column] = label
                came_from[column] = row
                if row_of[column] < 0:
                    end, shortest = column, label
                elif places[column] >= 0:
                    _lift(keys, items, places, places[column], label, column)
                elif label > distance:
                    _lift(keys, items, places, heap, label, column)
                    heap += 1
                else:
                    tied[tied_count] = column
                    tied_count += 1
            if not is_whole and rests[row] - offset < shortest:
                _lift(keys, items, places, heap, max(rests[row] - offset, distance), columns + row)
                heap += 1
            if shortest <= distance:
                break
            if taken < tied_count:
                item = tied[taken]
                taken += 1
            else:
                if heap == 0 or keys[0] >= shortest:
                    break
                distance, item = keys[0], items[0]
                _take_first(keys, items, places, heap)
                heap -= 1
            if item >= columns:
                row, is_whole = item - columns, True
            else:
                is_closed[item] = True
                closed[closed_count] = item
                closed_count += 1
                row, is_whole = row_of[item], is_dense
                offsets[row] = paid[row] - prices[item] - distance
        for place in range(heap):
            places[items[place]] = -1
        for place in range(closed_count):
            column = closed[place]
            prices[column] += labels[column] - shortest
            is_closed[column] = False
        for place in range(seen_count):
            labels[seen[place]] = np.inf
        while True:
            row, column = came_from[end], end
            row_of[column] = row
            end = column_of[row]
            column_of[row] = column
            paid[row] = costs[row, column]
            if end < 0:
                break
    return column_of
