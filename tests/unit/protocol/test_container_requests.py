"""What a client may ask for containers and nodes, and how it is told what is wrong."""

from __future__ import annotations

import tracemalloc
from itertools import pairwise
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rce.model.checks import find_circle
from rce.model.requests import ConfigureComponents, CreateContainer, ResizeContainer
from rce.model.specs import Network, ResourceChanges, Resources
from rce.protocol.exceptions import MessageError
from rce.protocol.requests import read_request


def create(**data: object) -> Resources:
    request = read_request("CC", {"containerTag": "c", "containerData": data})
    assert isinstance(request, CreateContainer)
    return request.resources


@pytest.mark.parametrize(
    ("data", "problem"),
    [
        ({"memory": "lots"}, r'containerData\.memory: must be a number of MB such as 256, or .* "256M"'),
        ({"memory": 200_000_000}, r'memory: must be at most .* bytes are written "200000000B"'),
        ({"cpu": "half"}, r"containerData\.cpu: must be a number of cores"),
        ({"cpu": []}, r"containerData\.cpu: must be int | float | str, not array"),
        ({"bandwidth": "5Mb"}, r'containerData\.bandwidth: must be .* "10Mbit"'),
        ({"network": "all"}, r"containerData\.network: must be one of none, group, host, not 'all'"),
        ({"network": "group"}, r"containerData\.group: is missing"),
        ({"groupIp": "10.0.0.2"}, r"containerData\.group: is missing"),
        ({"group": "g", "groupIp": "fe80::1"}, r"containerData\.groupIp: must be an IPv4 address such as"),
        ({"group": "g", "groupIp": "10.0.0.2/99"}, r"containerData\.groupIp: must be an IPv4 address"),
        ({"group": "g", "groupIp": "10.0.0.2/31"}, r"groupIp: must have a prefix from /8 to /30"),
        ({"group": "g", "groupIp": "10.0.0.255"}, r"groupIp: must be an address of a host in 10\.0\.0\.0/24"),
        ({"image": "--privileged"}, r"containerData\.image: must be an image's name"),
        ({"image": "a b"}, r"containerData\.image"),
        ({"wait": "yes"}, r"containerData\.wait: must be bool"),
        ({"size": 1.5}, r"containerData\.size: must be int"),
    ],
)  # fmt: skip
def test_invalid_request_is_named_with_place_and_fix(data: dict[str, Any], problem: str) -> None:
    with pytest.raises(MessageError, match=problem):
        create(**data)


def test_all_faults_of_a_container_are_told_at_once() -> None:
    with pytest.raises(MessageError) as caught:
        create(cpu="x", memory="y", image="-z")
    assert [part.split(":")[0] for part in str(caught.value).split("; ")] == [
        f"data.containerData.{key}" for key in ("cpu", "memory", "image")
    ]


def test_an_address_in_a_group_means_the_network_of_the_group() -> None:
    given = {"group": "g", "groupIp": "10.0.0.2"}
    assert create(**given).network is Network.GROUP
    assert create(**given, network="group").network is Network.GROUP
    assert create(**given, network="none").network is Network.NONE
    assert create(group="g").network is Network.NONE


def test_resizing_changes_what_it_names() -> None:
    request = read_request(
        "RC", {"containerTag": "c", "containerData": {"memory": "1G", "cpu": None, "group": "g"}}
    )
    assert isinstance(request, ResizeContainer)
    assert request.changes == ResourceChanges(memory=1 << 30)
    for data in ({}, {"cpu": None}, {"group": "g"}):
        with pytest.raises(
            MessageError, match=r"data\.containerData: says nothing; give one or more of size, cpu"
        ):
            read_request("RC", {"containerTag": "c", "containerData": data})
    with pytest.raises(MessageError, match=r"data\.containerData\.memory: must be"):
        read_request("RC", {"containerTag": "c", "containerData": {"memory": "all"}})


@pytest.mark.parametrize(
    ("keys", "problem"),
    [
        ({"restart": "sometimes"}, "restart: must be one of never, on-failure, always, not 'sometimes'"),
        ({"maxRestarts": -1}, "maxRestarts: must be int >= 0"),
        ({"after": "n"}, "after: must be array"),
        ({"after": ["n", "9"]}, r"after\[1\]: must be a name"),
        ({"heartbeat": "a b"}, "heartbeat: must be a ROS name"),
        ({"heartbeatTimeout": 0}, "heartbeatTimeout: must be float >= 0.1"),
    ],
)
def test_invalid_node_request_spares_other_nodes(keys: dict[str, Any], problem: str) -> None:
    node = {"containerTag": "c", "nodeTag": "n", "pkg": "p", "exe": "e"}
    request = read_request("CN", {"addNodes": [{**node, **keys}, node]})
    assert isinstance(request, ConfigureComponents)
    assert len(request.add_nodes) == 1
    (fault,) = request.faults
    with pytest.raises(MessageError, match=rf"^data\.addNodes\[0\]\.{problem}"):
        raise MessageError.of([fault])


TAGS = st.sampled_from("abcd")


@given(st.dictionaries(TAGS, st.lists(TAGS, max_size=3)), TAGS)
def test_a_circle_is_a_way_back(after: dict[str, list[str]], start: str) -> None:
    circle = find_circle(start, after)
    if circle:
        assert (circle[0], circle[-1]) == (start, start)
        assert all(to in after[of] for of, to in pairwise(circle))
    else:
        reached = set(after.get(start, ()))
        for _ in "abcd":
            reached |= {far for near in reached for far in after.get(near, ())}
        assert start not in reached


@pytest.mark.parametrize(
    ("after", "circle"),
    [
        ({"a": "bc", "b": "d", "c": "a", "d": "a"}, "aca"),
        ({"a": "bc", "b": "d", "c": "be", "d": "a", "e": "f"}, "acbda"),
        ({"a": "bd", "b": "c", "c": "a", "d": "bd"}, "adbca"),
        ({"a": "ab"}, "aa"),
        ({"a": "b", "b": "cb", "c": "b"}, ""),
        ({}, ""),
    ],
)
def test_a_circle_is_found_from_the_last_of_after(after: dict[str, str], circle: str) -> None:
    assert find_circle("a", after) == list(circle)


def test_a_long_way_with_many_names_takes_little_memory() -> None:
    count, others = 499, [f"other{number}" for number in range(999)]
    after = {f"n{number}": [*others, f"n{number + 1}"] for number in range(count)}
    tracemalloc.start()
    try:
        assert find_circle("n0", after) == []
        _, most = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert most < 20 << 20
    after[f"n{count}"] = ["n0"]
    assert len(find_circle("n0", after)) == count + 2
