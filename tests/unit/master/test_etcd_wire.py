"""Messages of etcd's gateway, as Debian's etcd 3.4 answers."""

from __future__ import annotations

import json
from base64 import b64decode

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rce_master.store.etcd import wire
from rce_master.store.etcd.layout import Keys
from rce_master.store.etcd.wire import Condition, Delete, Put, Subject

HEADER = {"cluster_id": "3249", "member_id": "3319", "revision": "2", "raft_term": "2"}
KV = {"key": "YQ==", "create_revision": "2", "mod_revision": "7", "version": "1"}


def test_a_transaction_has_numbers_as_texts_and_keys_in_base64() -> None:
    message = wire.txn_request(
        [Condition("a", Subject.CREATED, 0), Condition("b", Subject.VALUE, b"x")],
        [Put("c", b"\0\xff", lease=77), Delete("d")],
        ["e"],
    )
    assert message == {
        "compare": [
            {"key": "YQ==", "target": "CREATE", "result": "EQUAL", "create_revision": "0"},
            {"key": "Yg==", "target": "VALUE", "result": "EQUAL", "value": "eA=="},
        ],
        "success": [
            {"request_put": {"key": "Yw==", "value": "AP8=", "lease": "77"}},
            {"request_delete_range": {"key": "ZA=="}},
        ],
        "failure": [{"request_range": {"key": "ZQ=="}}],
    }


def test_many_operations_are_grouped_and_keep_their_order() -> None:
    operations = [Delete(f"key{number}") for number in range(2 * wire.GROUP + 1)]
    (flat,) = (wire.txn_request([], operations[: wire.GROUP])["success"],)
    assert len(flat) == wire.GROUP
    assert all("request_delete_range" in one for one in flat)
    groups = [one["request_txn"]["success"] for one in wire.txn_request([], operations)["success"]]
    assert [len(group) for group in groups] == [wire.GROUP, wire.GROUP, 1]
    keys = [b64decode(one["request_delete_range"]["key"]).decode() for group in groups for one in group]
    assert keys == [one.key for one in operations]


def test_a_page_with_an_empty_value_is_read() -> None:
    page = wire.read_page({"header": HEADER, "kvs": [KV], "count": "1"})
    assert page == wire.Page((wire.Record("a", b"", 2, 7),), 2, more=False, count=1)
    assert wire.read_page({"header": HEADER, "more": True}).more


def test_a_transaction_that_was_not_done_has_the_keys_found() -> None:
    answer = {
        "header": HEADER,
        "responses": [{"response_range": {"header": {"revision": "2"}, "kvs": [KV]}}, {"response_range": {}}],
    }
    assert wire.read_outcome(answer).found == (wire.Record("a", b"", 2, 7),)
    done = {"header": HEADER, "succeeded": True, "responses": [{"response_put": {}}]}
    assert wire.read_outcome(done) == wire.Outcome(done=True, revision=2)


def test_a_lease_that_ended_has_no_seconds() -> None:
    assert wire.read_lease({"header": HEADER, "ID": "23240353", "TTL": "3"}) == (23240353, 3)
    assert wire.read_lease({"result": {"header": HEADER, "ID": "77"}}) == (77, 0)


@pytest.mark.parametrize(
    "body",
    [
        {"error": "etcdserver: no leader", "message": "etcdserver: no leader", "code": 14},
        {"error": {"grpc_code": 14, "message": "etcdserver: no leader"}},
    ],
)
def test_errors_of_requests_and_of_streams_are_read(body: object) -> None:
    assert wire.read_fault(json.dumps(body).encode()) == wire.GatewayFault(14, "etcdserver: no leader")


@pytest.mark.parametrize(
    "body", [b"", b"Not Found\n", b"[]", b"{}", b'"error"', b'{"error": 3, "code": "x"}']
)
def test_answers_of_other_programs_are_no_errors_of_etcd(body: bytes) -> None:
    assert wire.read_fault(body) is None
    with pytest.raises(wire.WireError):
        wire.read_version(body)


@pytest.mark.parametrize("answer", [{}, {"header": 3}, {"header": HEADER, "kvs": [{"key": "?"}]}])
def test_broken_pages_are_refused(answer: wire.Message) -> None:
    with pytest.raises(wire.WireError):
        wire.read_page(answer)


@given(st.text(min_size=1, max_size=8), st.text(max_size=8))
def test_the_range_of_a_prefix_holds_exactly_its_keys(prefix: str, key: str) -> None:
    message = wire.range_request(prefix)
    begin, end = b64decode(message["key"]), b64decode(message["range_end"])
    encoded = key.encode()
    assert (begin <= encoded < end) == encoded.startswith(prefix.encode())


@given(st.from_regex(r"[a-z_]+", fullmatch=True), st.text(max_size=20))
def test_a_row_is_read_as_it_was_named(table: str, key: str) -> None:
    keys = Keys("/rce")
    assert keys.read_row(keys.row(table, key)) == (table, key)


def test_a_watch_tells_writes_and_removals_in_their_order() -> None:
    removed = {"type": "DELETE", "kv": {"key": "YQ==", "mod_revision": "9"}}
    line = json.dumps({"result": {"header": HEADER, "events": [{"kv": KV}, removed]}}).encode()
    assert wire.read_watched(line) == wire.Watched(
        (wire.Change("a", b"", 7), wire.Change("a", None, 9)), revision=9
    )
    assert wire.read_watched(b'{"result": {"created": true}}') == wire.Watched((), 0)


def test_a_watch_tells_of_a_compaction() -> None:
    line = b'{"result": {"canceled": true, "compact_revision": "12"}}'
    assert wire.read_watched(line) == wire.Watched((), 0, compacted=12)


@pytest.mark.parametrize(
    "line",
    [
        b"",
        b"[]",
        b'{"error": {"code": 14}}',
        b'{"result": {"canceled": true}}',
        b'{"result": {"events": [{}]}}',
    ],
)
def test_what_is_no_answer_to_a_watch_is_refused(line: bytes) -> None:
    with pytest.raises(wire.WireError):
        wire.read_watched(line)


def test_faults_of_a_cluster_are_those_of_its_status() -> None:
    status = {"header": HEADER, "errors": ["memberID:5 alarm:NOSPACE "]}
    assert wire.read_faults(status) == ("memberID:5 alarm:NOSPACE ",)
    assert wire.read_faults({"header": HEADER}) == ()
    for other in ({}, {"header": HEADER, "errors": 1}):
        with pytest.raises(wire.WireError):
            wire.read_faults(other)
