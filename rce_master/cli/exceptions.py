"""The errors of the commands.

::

    CliError            printed as it is; the program ends with code 1
    +-- ApiError          the master refused
    +-- NotLoggedInError  there is no token
"""

from __future__ import annotations


class CliError(Exception):
    """Printed as it is; the program ends with code 1."""


class ApiError(CliError):
    """The master refused a request.

    Attributes:
        status: HTTP status.
    """

    def __init__(self, status: int, text: str) -> None:
        self.status = status
        super().__init__(text)


class NotLoggedInError(CliError):
    """There is no token."""

    def __str__(self) -> str:
        return "not logged in; run: rce login"
