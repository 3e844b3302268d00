"""What keeps a package from coming into a container.

PackageTrouble              told to the owner as it is; it is tried again
├── Unfetched              the master is away, or does not have it
├── Unverified             it is not what its owner signed, or not a package at all
├── NoSpace                the machine's disk cannot take it
└── RequirementsTrouble    what it needs of Python cannot be installed
"""

from __future__ import annotations

from typing import ClassVar


class PackageTrouble(Exception):  # noqa: N818 - base of what is told to a package's owner
    """A package cannot come into a container now; the text says why and what to do.

    Attributes:
        delay_factor: How much longer than usual to wait before the next attempt.
    """

    delay_factor: ClassVar[float] = 1.0


class Unfetched(PackageTrouble):
    """The master is away, or does not have it."""


class Unverified(PackageTrouble):
    """It is not what its owner signed, or not a package at all."""


class NoSpace(PackageTrouble):
    """The machine's disk cannot take it."""


class RequirementsTrouble(PackageTrouble):
    """What it needs of Python cannot be installed."""

    delay_factor = 10.0  # each attempt costs the machine, and whoever serves the distributions, a lot
