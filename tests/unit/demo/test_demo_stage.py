"""What the planner is told."""

from __future__ import annotations

from rce.config.client import loads
from rce_client.demo.floor import draw
from rce_client.demo.stage import planner_parameters
from rce_client.fleet_config import as_text, fleet_config


def test_the_planner_is_not_told_of_hidden_boxes() -> None:
    scenario = draw(3, 0)
    parameters = planner_parameters(scenario, 0)
    assert parameters["walls"] == sorted(scenario.grid.blocked)
    assert parameters["blocked"] == list(scenario.known_boxes)
    assert not {*parameters["walls"], *parameters["blocked"]}.intersection(scenario.hidden_boxes)
    loads(as_text(fleet_config(None, parameters)))
