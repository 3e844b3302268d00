"""Random choices that a seed repeats. Pure."""

from __future__ import annotations

import random


def generator(seed: int, name: str) -> random.Random:
    """Return a generator of its own for one who chooses: how often the others choose depends on time.

    Args:
        seed: Of the run.
        name: Of the one who chooses.
    """
    return random.Random(f"{seed} {name}")
