"""What is chosen, what is registered of it, and what must not be."""

from __future__ import annotations

import re
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rce.ros.multimaster.errors import MalformedStateError, MultimasterError
from rce.ros.multimaster.filters import SyncFilter, SyncLists
from rce.ros.multimaster.heartbeat import Stamp
from rce.ros.multimaster.patterns import Patterns
from rce.ros.multimaster.plan import (
    Registration,
    RegistrationKind,
    split_clashes,
    unreachable_nodes,
    wanted,
)
from rce.ros.multimaster.state import MasterInfo, Provider

NAMES = st.text("ab/_", max_size=6)
OWN, THEIRS, THIRD = (f"http://10.0.0.{number}:11311/" for number in (1, 2, 3))


@given(st.lists(st.text("ab/*", max_size=6), max_size=4), NAMES)
def test_patterns_mean_what_the_expressions_of_fkie_mean(patterns: list[str], name: str) -> None:
    ours = Patterns(patterns)
    expression = ours.to_wire()
    expected = bool(expression) and re.compile(expression, re.IGNORECASE).match(name) is not None
    assert ours.match(name) == expected
    again = Patterns.from_wire(expression)
    assert again is not None
    assert again.match(name) == expected


def test_patterns_ignore_case_and_blanks() -> None:
    assert Patterns([" /Robot* "]).match("/robot1/pose")


@pytest.mark.parametrize("expression", [r"(a+)+$", r"\A/robot[12]/.*\Z", r"\A(a|b)*\Z", "/x"])
def test_other_expressions_are_no_patterns(expression: str) -> None:
    assert Patterns.from_wire(expression) is None


def test_a_long_hostile_name_is_matched_quickly() -> None:
    assert not Patterns(["*a" * 500 + "b"]).match("a" * 100_000)


def test_ignore_wins() -> None:
    chosen = SyncLists.read({"sync_topics": ["/a*"], "ignore_topics": ["/ab"]}).filter_for("robot")
    assert chosen.takes_publisher("/n", "/a", "t/T")
    assert not chosen.takes_publisher("/n", "/ab", "t/T")
    assert not chosen.takes_publisher("/n", "/b", "t/T")


@pytest.mark.parametrize(
    ("node", "topic", "kind"),
    [
        ("/n", "/rosout", "rosgraph_msgs/Log"),
        ("/n", "/rosout_agg", "rosgraph_msgs/Log"),
        ("/master_sync", "/t", "t/T"),
        ("/n", "/master_discovery/changes", "fkie_multimaster_msgs/MasterState"),
        ("/n", "/bond", "bond/Status"),
    ],
)
def test_what_belongs_to_a_master_is_never_taken(node: str, topic: str, kind: str) -> None:
    chosen = SyncLists().filter_for("robot")
    assert not chosen.takes_publisher(node, topic, kind)
    assert not chosen.takes_subscriber(node, topic, kind)
    assert not chosen.takes_service("/n", "/n/get_loggers")
    assert not chosen.takes_service("/n", "/n/set_logger_level")
    assert chosen.takes_service("/n", "/n/clear")


def test_chosen_nodes_and_topics_add_up() -> None:
    chosen = SyncLists.read({"sync_nodes": ["/amcl"], "sync_topics": ["/map"]}).filter_for("robot")
    assert chosen.takes_publisher("/amcl", "/pose", "t/T")
    assert chosen.takes_publisher("/server", "/map", "t/T")
    assert not chosen.takes_publisher("/server", "/pose", "t/T")
    assert not chosen.takes_service("/server", "/clear")


def test_lists_for_one_master() -> None:
    lists = SyncLists.read({"sync_topics": ["/a", {"robot": ["/b"]}], "ignore_hosts": "bad*"})
    assert lists.filter_for("robot").takes_publisher("/n", "/b", "t/T")
    assert not lists.filter_for("other").takes_publisher("/n", "/b", "t/T")
    assert lists.takes_host("good")
    assert not lists.takes_host("bad1")


@pytest.mark.parametrize("values", [{"sync_topic": []}, {"sync_topics": 3}])
def test_settings_that_mean_nothing_are_refused(values: dict[str, object]) -> None:
    with pytest.raises(MultimasterError, match="sync_topic"):
        SyncLists.read(values)


def test_a_filter_travels() -> None:
    chosen = SyncLists.read({"sync_topics": ["/a*"], "ignore_nodes": ["/n"]}).filter_for("robot")
    values = chosen.to_wire()
    assert [type(value) for value in values] == [bool] + [str] * 10
    read = SyncFilter.from_wire(values)
    for node, topic in [("/m", "/ab"), ("/n", "/ab"), ("/m", "/b"), ("/m", "/rosout")]:
        assert read.takes_publisher(node, topic, "t/T") == chosen.takes_publisher(node, topic, "t/T")


def test_a_filter_that_is_not_understood_lets_more_pass() -> None:
    values = [False, r"\A/n[0-9]\Z", "", "", r"\A/(a|b)\Z"]
    read = SyncFilter.from_wire(values)
    assert read.takes_publisher("/n1", "/a", "t/T")
    assert read.takes_publisher("/n1", "/c", "t/T")


def remote(**more: object) -> MasterInfo:
    here = Provider("http://10.0.0.2:5000/", THEIRS, is_local=True)
    info = MasterInfo(
        THEIRS,
        "robot",
        Stamp(5, 1),
        Stamp(4, 2),
        publishers={"/said": ("/talker",), "/rosout": ("/talker",)},
        subscribers={"/goal": ("/talker",)},
        services={"/clear": ("/talker",)},
        topic_types={"/said": "t/T", "/rosout": "rosgraph_msgs/Log"},
        nodes={"/talker": here},
        service_uris={"/clear": Provider("rosrpc://10.0.0.2:5001", THEIRS, is_local=True)},
    )
    return replace(info, **more)  # type: ignore[arg-type]  # any of its fields


def names(entries: set[Registration]) -> set[tuple[str, str, str]]:
    return {(entry.kind.value, entry.name, entry.detail) for entry in entries}


CHOSEN = SyncLists().filter_for("robot")


def test_what_a_master_has_is_wanted() -> None:
    assert names(wanted(remote(), OWN, CHOSEN)) == {
        ("publisher", "/said", "t/T"),
        ("subscriber", "/goal", "*"),
        ("service", "/clear", "rosrpc://10.0.0.2:5001"),
    }


def test_what_came_from_here_is_not_taken_back() -> None:
    ours = {"/talker": Provider("http://10.0.0.1:5000/", OWN, is_local=False)}
    assert wanted(remote(nodes=ours), OWN, CHOSEN) == set()


@pytest.mark.parametrize("with_remote", [False, True])
def test_what_came_from_a_third_master_is_left_to_that(with_remote: bool) -> None:
    chosen = replace(CHOSEN, sync_remote_nodes=with_remote)
    third = {"/talker": Provider("http://10.0.0.3:5000/", THIRD, is_local=False)}
    assert wanted(remote(nodes=third), OWN, chosen) == set()


@pytest.mark.parametrize("with_remote", [False, True])
def test_nodes_on_another_machine_than_their_master(with_remote: bool) -> None:
    chosen = replace(CHOSEN, sync_remote_nodes=with_remote)
    elsewhere = {"/talker": Provider("http://10.0.0.9:5000/", THEIRS, is_local=False)}
    assert bool(wanted(remote(nodes=elsewhere), OWN, chosen)) == with_remote


def test_nodes_at_loopback_are_not_registered_elsewhere() -> None:
    info = remote(nodes={"/talker": Provider("http://127.0.0.1:5000/", THEIRS, is_local=True)})
    assert wanted(info, OWN, CHOSEN) == set()
    assert unreachable_nodes(info) == ["/talker"]
    same_machine = replace(info, uri="http://127.0.0.1:11312/")
    assert unreachable_nodes(same_machine) == []


ENTRY = Registration(RegistrationKind.PUBLISHER, "/said", "/talker", "http://10.0.0.2:5000/", "t/T")
SERVICE = replace(ENTRY, kind=RegistrationKind.SERVICE, name="/clear", detail="rosrpc://10.0.0.2:5001")


def test_a_node_of_the_same_name_is_left_alone() -> None:
    fine, clashes = split_clashes([ENTRY], {"/talker": "http://10.0.0.1:7000/"}, {})
    assert fine == set()
    assert "/talker" in str(clashes[0])
    assert "http://10.0.0.1:7000/" in str(clashes[0])


def test_the_very_node_is_neither_registered_nor_a_clash() -> None:
    assert split_clashes([ENTRY], {"/talker": ENTRY.uri}, {}) == (set(), [])


def test_a_service_of_the_same_name_is_left_alone() -> None:
    fine, clashes = split_clashes([ENTRY, SERVICE], {}, {"/clear": "rosrpc://10.0.0.1:1"})
    assert fine == {ENTRY}
    assert "service /clear" in str(clashes[0])


def test_a_state_travels() -> None:
    info = remote()
    assert MasterInfo.from_wire(info.to_wire()) == info
    assert info.to_wire()[:4] == ["5.000000001", "4.000000002", THEIRS, "robot"]


def test_a_state_of_fkie_is_read() -> None:
    values = remote().to_wire()
    values[7].append(["/untyped", "None"])
    values[8] = [
        ("/talker", "http://10.0.0.2:5000/", THEIRS, None, "local"),
        ("/x", None, THEIRS, None, "local"),
    ]
    assert MasterInfo.from_wire(tuple(values)) == remote()


@pytest.mark.parametrize("values", [None, [], [1] * 10, ["x", "0", "", "", [], [], [], [], [], []]])
def test_what_is_no_state_is_refused(values: object) -> None:
    with pytest.raises(MalformedStateError):
        MasterInfo.from_wire(values)


def test_a_synchronized_change_is_no_change_of_the_own_part() -> None:
    synced = remote(
        nodes={**remote().nodes, "/far": Provider("http://10.0.0.3:1/", THIRD, is_local=False)},
        publishers={**remote().publishers, "/far_said": ("/far",)},
    )
    assert synced.own_part() == remote().own_part()
    assert not synced.same_graph(remote())
