"""Machines with shaped links: what was asked for is what programs measure."""

from __future__ import annotations

import subprocess
import sys

import pytest

from rce_fleet.exceptions import ExperimentError
from rce_fleet.experiments import machines as module
from rce_fleet.experiments.bench import CLIENT, Bench
from rce_fleet.experiments.delay_line import LinkShape
from rce_fleet.experiments.machines import MachineLink, MachineNetwork

needs_machines = pytest.mark.needs("netns")


def namespaces() -> str:
    return subprocess.run(["ip", "netns"], check=True, capture_output=True, text=True).stdout


@needs_machines
async def test_links_are_shaped_as_asked_for() -> None:
    slow = MachineLink(rate=20e6, shape=LinkShape(delay=0.01, jitter=0.001))
    async with MachineNetwork({"server": MachineLink(), "robot": slow}) as network:
        assert [machine.address for machine in network.machines.values()] == ["10.89.0.1", "10.89.0.2"]
        before = await network.traffic("robot")
        found = await network.probe("robot", "server")
        after = await network.traffic("robot")
        assert found.round_trip_s >= 0.018
        assert found.lost < 0.2
        assert found.rate <= 20e6
        assert 0 < found.rate_back <= 20e6
        sent = after.sent_bytes - before.sent_bytes
        assert sent > found.rate / 8, "the stream took over a second"
        assert after.received_bytes - before.received_bytes > found.rate_back / 8, "so did the one back"
        server = await network.traffic("server")
        assert server.received_bytes >= 0.9 * sent
    assert network._tag not in namespaces()


@needs_machines
async def test_what_was_made_is_removed_if_a_part_cannot_be_made(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "SUBNET", "10.89.999")
    network = MachineNetwork({"server": MachineLink()})
    with pytest.raises(ExperimentError, match=r"address add 10\.89\.999\.1/24 dev wlan0"):
        await network.__aenter__()
    assert network._tag not in namespaces()


async def test_a_missing_tool_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "TOOLS", ("ip", "no-such-tool"))
    with pytest.raises(ExperimentError, match="making them needs the program no-such-tool"):
        await MachineNetwork({}).__aenter__()


@needs_machines
async def test_a_link_gets_another_shape_while_it_is_in_use() -> None:
    links = {"server": MachineLink(), "robot": MachineLink(shape=LinkShape(delay=0.001))}
    async with MachineNetwork(links) as network:
        near = await network.probe("robot", "server")
        await network.reshape("robot", LinkShape(delay=0.03))
        far = await network.probe("robot", "server")
        assert near.round_trip_s < 0.04
        assert far.round_trip_s >= 0.055
        assert await network.emulation_s() > 0
        with pytest.raises(ExperimentError, match="the link of server has no delay"):
            await network.reshape("server", LinkShape(delay=0.03))


@needs_machines
async def test_a_link_gets_another_rate_while_it_is_in_use() -> None:
    async with MachineNetwork({"server": MachineLink(), "robot": MachineLink(rate=20e6)}) as network:
        await network.set_rate("robot", 2e6)
        found = await network.probe("robot", "server")
        assert max(found.rate, found.rate_back) <= 2e6
        with pytest.raises(ExperimentError, match="server was made without a rate"):
            await network.set_rate("server", 2e6)


@needs_machines
async def test_programs_do_not_use_the_proxy_of_the_computer(monkeypatch: pytest.MonkeyPatch) -> None:
    """It cannot be reached from the machines, and their addresses are not among its exceptions."""
    monkeypatch.setenv("http_proxy", "http://proxy.example.com:3128")
    monkeypatch.setenv("ALL_PROXY", "socks5://proxy.example.com:1080")
    code = "import os, urllib.request; print(urllib.request.getproxies(), os.environ.get('ALL_PROXY'))"
    async with Bench() as bench:
        assert await bench.run(CLIENT, "proxies", [sys.executable, "-c", code]) == "{} None\n"
