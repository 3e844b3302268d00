"""The services of a node's state, as users write them."""

from __future__ import annotations

import json
from typing import Any

import pytest

from rce.config.client import loads
from rce.config.exceptions import ConfigError
from rce.model import AddNode, SpecError, StateServices
from rce.protocol.requests import SPELLING

NODE = {"containerTag": "c", "nodeTag": "n", "pkg": "p", "exe": "e"}


def read(state: Any) -> StateServices | None:
    return SPELLING.read(AddNode, {**NODE, "state": state}).node.state_services


def test_services_are_read_with_a_default_period() -> None:
    assert read({"save": "save", "restore": "~restore"}) == StateServices(
        save="save", restore="~restore", every=10.0
    )
    assert read(None) is None


@pytest.mark.parametrize(
    ("state", "text"),
    [
        ({"save": "save"}, "state.restore: is missing"),
        ({"restore": "restore", "every": 5}, "state.save: is missing"),
        ({"save": "save", "restore": "save"}, "state: save and restore must be two services"),
        ({"save": "no name", "restore": "r"}, "state.save: must be a ROS name"),
        ({"save": "s", "restore": "r", "every": 0.5}, "state.every: must be float >= 1"),
        ({"save": "s", "restore": "r", "every": "often"}, "state.every: must be float"),
        ({"save": "s", "restore": "r", "period": 5}, "state: "),
        ("save", "state: must be object"),
    ],
)
def test_wrong_services_are_named(state: Any, text: str) -> None:
    with pytest.raises(SpecError) as caught:
        read(state)
    assert text in str(caught.value)


def test_a_config_file_names_the_place() -> None:
    file = {"url": "http://127.0.0.1:9000/", "userID": "u", "password": "p", "robotID": "r"}
    node = {"cTag": "c", "nTag": "n", "pkg": "p", "exe": "e", "state": {"save": "s", "restore": "s"}}
    with pytest.raises(ConfigError, match=r"nodes.*state.*two services"):
        loads(json.dumps({**file, "containers": [{"cTag": "c"}], "nodes": [node]}))
