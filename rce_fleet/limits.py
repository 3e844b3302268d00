"""Limits of the numbers that people and programs give: what is beyond them breaks sums or messages."""

MOST_CELL = 2**31 - 1
"""Largest number of a cell: messages have 32 bits for it."""
MOST_METRES = 1e9
"""Farthest place, metres from the map's origin along x or y: sums of greater ones are not finite."""
MOST_TIME = 1e11
"""Latest time, seconds since 1970: in three thousand years."""
MOST_LATE = 1e9
"""Seconds; a task that is later is not more urgent."""
MOST_OCCURRENCES = 10**9
MOST_REVISION = 2**53
"""Largest number of a robot's list of cells: messages have 63 bits, and the planner counts on from it."""
MOST_AMOUNT = 1e6
"""Most kilograms, watts, watt hours, and watt hours for each metre."""
LEAST_CAPACITY = 1e-3
"""Watt hours of a full battery."""
LEAST_SPEED, MOST_SPEED = 0.01, 100.0
"""Metres per second, of a robot and in a slow zone."""
LEAST_FACTOR, MOST_FACTOR = 0.01, 1e6
"""How much a metre in a zone counts for a robot. A sum of ways must grow with each metre."""
MOST_ROOM = 10**6
"""Most robots for which a limited zone can have room."""
MOST_ZONES = 1000
"""Zones at the same time: each change of one looks at all of them, for each robot."""
MOST_REASON = 500
"""Characters of a reason."""
MOST_LIFETIME = 1e10
"""Longest life of a zone, seconds."""


def within(value: float, least: float, most: float) -> float:
    """Return the number of a range that is nearest to a value."""
    return min(max(value, least), most)
