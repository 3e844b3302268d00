"""The kernel tells which user opened a connection."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import pytest
from support.other_user import OTHER_USER, as_user

from rce.web.local import user_of


@contextmanager
def listening(family: socket.AddressFamily, host: str) -> Iterator[socket.socket]:
    with socket.socket(family) as server:
        server.settimeout(60)
        server.bind((host, 0))
        server.listen()
        yield server


@pytest.mark.parametrize(
    ("family", "bind", "host"),
    [
        (socket.AF_INET, "127.0.0.1", "127.0.0.1"),
        (socket.AF_INET6, "::1", "::1"),
        (socket.AF_INET, "127.0.0.1", "::ffff:127.0.0.1"),
    ],
)
def test_user_of_own_connection(family: socket.AddressFamily, bind: str, host: str) -> None:
    with ExitStack() as stack:
        server = stack.enter_context(listening(family, bind))
        client = stack.enter_context(socket.create_connection((host, server.getsockname()[1])))
        accepted = stack.enter_context(server.accept()[0])
        assert user_of(accepted.getpeername()[:2], accepted.getsockname()[:2]) == os.geteuid()
        client.close()
        with pytest.raises(ConnectionError):
            user_of(accepted.getpeername()[:2], accepted.getsockname()[:2])


@pytest.mark.needs("root")
def test_user_of_connection_of_another_user() -> None:
    with ExitStack() as stack:
        server = stack.enter_context(listening(socket.AF_INET, "127.0.0.1"))
        with as_user(OTHER_USER):
            stack.enter_context(socket.create_connection(server.getsockname()))
        accepted = stack.enter_context(server.accept()[0])
        assert user_of(accepted.getpeername()[:2], accepted.getsockname()[:2]) == OTHER_USER
