"""Rates of connections, from counters that interfaces report."""

from __future__ import annotations

from typing import Any

import pytest

from rce_fleet.station.rates import WINDOW_S, InterfaceRates, Rate


def interface(endpoint: str, tag: str, messages: int, size: int) -> dict[str, Any]:
    half, rest = messages // 2, messages - messages // 2
    counters = {"messages_in": half, "messages_out": rest, "bytes_in": size, "bytes_out": 0}
    return {"endpoint": endpoint, "tag": tag, **counters}


def test_rate_is_of_the_end_that_exchanges_less() -> None:
    """The planner's interface counts for two robots; each robot's only for itself."""
    rates = InterfaceRates()
    assert rates.of_connection("fleet/status", "robot1/status") is None
    for second in range(4):
        rates.take(
            100.0 + second,
            [
                interface("fleet", "status", 30 * second, 3000 * second),
                interface("robot1", "status", 20 * second, 2000 * second),
                interface("robot2", "status", 10 * second, 1000 * second),
            ],
        )
    assert rates.of_connection("fleet/status", "robot1/status") == Rate(20.0, 2000.0)
    assert rates.of_connection("fleet/status", "robot2/status") == Rate(10.0, 1000.0)
    assert rates.of_connection("fleet/other", "robot2/other") is None


def test_rate_forgets_what_is_older_than_its_window() -> None:
    rates = InterfaceRates()
    for second in range(60):
        rates.take(float(second), [interface("robot1", "scan", 10 * min(second, 30), 0)])
    assert rates.of_interface("robot1/scan") == Rate(0.0, 0.0)
    rates.take(60.0, [interface("robot1", "scan", 450, 0)])
    assert rates.of_interface("robot1/scan") == pytest.approx(Rate(150 / WINDOW_S, 0.0))


def test_a_restarted_endpoint_counts_from_zero() -> None:
    rates = InterfaceRates()
    rates.take(0.0, [interface("robot1", "scan", 1000, 5000)])
    rates.take(10.0, [interface("robot1", "scan", 20, 400)])
    assert rates.of_interface("robot1/scan") == Rate(2.0, 40.0)
