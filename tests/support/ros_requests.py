"""Counts the XML-RPC requests to servers of the test's process."""

from __future__ import annotations

import pytest

from rce.ros.xmlrpc import Dispatcher


def count_requests(patch: pytest.MonkeyPatch) -> list[int]:
    """Return a list that grows by the length of each request from now on."""
    lengths: list[int] = []
    respond = Dispatcher.respond

    def count(self: Dispatcher, document: bytes) -> bytes:
        lengths.append(len(document))
        return respond(self, document)

    patch.setattr(Dispatcher, "respond", count)
    return lengths
