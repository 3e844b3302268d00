"""The errors that keep a package out of a container.

PackageTroubleError              told to the owner as it is; it is tried again
├── FetchError                   the master is away, or does not have it
├── VerificationError            it is not what its owner signed, or not a package at all
├── NoSpaceError                 the machine's disk cannot take it
└── RequirementsTroubleError     what it needs of Python cannot be installed
"""

from __future__ import annotations

from typing import ClassVar


class PackageTroubleError(Exception):
    """A package cannot be given to a container now; the text says why and what to do.

    Attributes:
        delay_factor: How much longer than usual to wait before the next attempt.
    """

    delay_factor: ClassVar[float] = 1.0


class FetchError(PackageTroubleError):
    """The master is away, or does not have it."""


class VerificationError(PackageTroubleError):
    """It is not what its owner signed, or not a package at all."""


class NoSpaceError(PackageTroubleError):
    """The machine's disk cannot take it."""


class RequirementsTroubleError(PackageTroubleError):
    """What it needs of Python cannot be installed."""

    delay_factor = 10.0  # each attempt is expensive for the machine and for the package index
