"""Ports that are chosen, and ports that are taken."""

from __future__ import annotations

import socket
from dataclasses import astuple, replace

import pytest

from rce_fleet.demo.exceptions import PortInUseError
from rce_fleet.demo.resources import ANY, QUIET_PORTS, Ports, option_of


def test_free_ports_are_all_different_and_free() -> None:
    ports = astuple(ANY.choose())
    assert len(set(ports)) == len(ports)
    for port in ports:
        assert port in QUIET_PORTS
        socket.create_server(("127.0.0.1", port)).close()


@pytest.mark.parametrize(
    ("name", "option"),
    [("page", "--port"), ("http", "--http-port"), ("container_link", "--container-link-port")],
)
def test_a_taken_port_is_named_with_its_option(name: str, option: str) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        with pytest.raises(PortInUseError, match=f"port {port} is in use.* {option}$"):
            replace(ANY, **{name: port}).choose()
    assert option_of(name) == option


def test_ports_that_are_given_are_kept() -> None:
    chosen = ANY.choose()
    assert chosen.choose() == chosen
    assert Ports().http == 9000


def test_ports_that_are_not_needed_may_be_in_use() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        taken = server.getsockname()[1]
        ports = replace(ANY, http=taken).choose(["page", "core"])
    assert ports.http == taken
    assert ports.ws == 0
    assert {ports.page, ports.core}.isdisjoint({0, taken})
