"""What keeps a package from coming into a container.

BundleTrouble              told to the owner as it is; it is tried again
├── Unfetched              the master is away, or does not have it
├── Unverified             it is not what its owner signed, or no bundle at all
├── NoSpace                the machine's disk cannot take it
└── RequirementsTrouble    what it needs of Python cannot be installed
"""

from __future__ import annotations

from typing import ClassVar


class BundleTrouble(Exception):  # noqa: N818 - base of what is told to a package's owner
    """A package cannot come into a container now; the text says why and what to do.

    Attributes:
        patience: How many times the usual pause is made before it is tried again.
    """

    patience: ClassVar[float] = 1.0


class Unfetched(BundleTrouble):
    """The master is away, or does not have it."""


class Unverified(BundleTrouble):
    """It is not what its owner signed, or no bundle at all."""


class NoSpace(BundleTrouble):
    """The machine's disk cannot take it."""


class RequirementsTrouble(BundleTrouble):
    """What it needs of Python cannot be installed."""

    patience = 10.0  # each attempt costs the machine, and whoever serves the distributions, a lot
