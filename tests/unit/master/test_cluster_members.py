"""Which changes of the members of etcd are allowed, and what is written for them."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

from rce_master.cluster.files import CERTIFICATE, Machine, read_config
from rce_master.cluster.members import (
    ClusterError,
    Member,
    advice,
    check_new,
    check_removal,
    find,
    read_alarms,
    read_members,
    read_status,
)
from rce_master.store.etcd.wire import WireError


def members(count: int, *, learner: int = 0) -> list[Member]:
    return [
        Member(number, f"m{number}", f"10.0.0.{number}:2380", f"10.0.0.{number}:2379", number == learner)
        for number in range(1, count + 1)
    ]


def machine(folder: Path, *, tls: bool = True, name: str = "m1") -> Machine:
    return Machine(name, "10.0.0.1", 2379, 2380, folder, tls)


def test_members_are_read() -> None:
    answer = {
        "members": [
            {"ID": "17", "name": "m1", "peerURLs": ["http://a:2380"], "clientURLs": ["http://a:2379"]},
            {"ID": "18", "peerURLs": ["https://[::1]:2380"], "isLearner": True},
        ]
    }
    first, second = read_members(answer)
    assert first == Member(17, "m1", "a:2380", "a:2379")
    assert (second.shown, second.host, second.client, second.is_learner) == ("12", "::1", "", True)


@pytest.mark.parametrize("answer", [{}, {"members": [{"ID": "x"}]}, {"members": 1}])
def test_other_answers_are_no_members(answer: dict[str, object]) -> None:
    with pytest.raises(WireError):
        read_members(answer)


def test_status_and_alarms_are_read() -> None:
    status = read_status(
        {"header": {"member_id": "5"}, "version": "3.4.23", "dbSize": "20480", "leader": "5"}
    )
    assert (status.id, status.size, status.leader, status.term) == (5, 20480, 5, 0)
    assert read_alarms({"alarms": [{"memberID": "5", "alarm": "NOSPACE"}]}) == {5: ("NOSPACE",)}
    assert read_alarms({}) == {}
    with pytest.raises(WireError):
        read_status({"version": "3.4.23"})


@pytest.mark.parametrize(
    ("name", "client", "peer", "error"),
    [
        ("m2", "10.0.0.9:2379", "10.0.0.9:2380", "named m2 already"),
        ("m9", "10.0.0.2:2379", "10.0.0.9:2380", "m2 has the address"),
        ("m9", "10.0.0.9:2379", "10.0.0.2:2380", "m2 has the address"),
    ],
)
def test_names_and_addresses_are_unique(name: str, client: str, peer: str, error: str) -> None:
    with pytest.raises(ClusterError, match=error):
        check_new(members(3), name, client, peer)
    check_new(members(3), "m4", "10.0.0.4:2379", "10.0.0.4:2380")


@pytest.mark.parametrize(
    ("count", "healthy", "leaving", "error"),
    [
        (3, {1, 2, 3}, "m3", ""),
        (3, {1, 2}, "m3", ""),
        (3, {1, 2}, "m2", "m3 does not answer"),
        (5, {1, 2, 3}, "m1", "3 of|m4, m5 does not answer"),
        (5, {1, 2, 3, 4}, "m5", ""),
        (2, {1}, "m2", ""),
        (2, {1}, "m1", "m2 does not answer"),
        (1, {1}, "m1", "the last member"),
    ],
)
def test_removal_needs_a_quorum_of_the_others(
    count: int, healthy: set[int], leaving: str, error: str
) -> None:
    all_ = members(count)
    if error:
        with pytest.raises(ClusterError, match=error):
            check_removal(all_, healthy, find(all_, leaving))
    else:
        check_removal(all_, healthy, find(all_, leaving))


def test_a_learner_can_always_be_removed() -> None:
    all_ = members(2, learner=2)
    check_removal(all_, {1}, find(all_, "m2"))
    with pytest.raises(ClusterError, match="members: m1, m2"):
        find(all_, "m7")


@pytest.mark.parametrize(
    ("count", "text"),
    [
        (1, "join two more"),
        (2, "cannot be highly available"),
        (3, ""),
        (4, "no more failures than 3"),
        (5, ""),
    ],
)
def test_advice_on_the_number_of_machines(count: int, text: str) -> None:
    found = advice(members(count))
    assert (text in found) if text else (found == "")


def test_configuration_is_written_and_read(tmp_path: Path) -> None:
    own = machine(tmp_path / "state")
    own.write({"m1": own.peer_url, "m2": "https://10.0.0.2:2380"}, new=False)
    found = read_config(own.config)
    assert (found["max-txn-ops"], found["pre-vote"]) == (4096, True)
    assert found["initial-cluster"] == "m1=https://10.0.0.1:2380,m2=https://10.0.0.2:2380"
    assert found["initial-cluster-state"] == "existing"
    assert found["peer-transport-security"] == found["client-transport-security"]
    assert found["client-transport-security"]["cert-file"].endswith(f"{CERTIFICATE}.pem")
    assert "&" not in own.config.read_text()
    plain = machine(tmp_path, tls=False).document({"m1": "http://10.0.0.1:2380"}, new=True)
    assert "client-transport-security" not in plain
    assert plain["initial-cluster-state"] == "new"


def test_etcd_reads_the_list_of_revoked_certificates_if_there_is_one(tmp_path: Path) -> None:
    one = machine(tmp_path)
    one.certificates.mkdir()
    assert "ClientTLSInfo" not in one.document({}, new=True)
    (one.certificates / "revoked.pem").touch()
    found = one.document({}, new=True)
    expected = {"CRLFile": str(one.certificates / "revoked.pem")}
    assert (found["ClientTLSInfo"], found["PeerTLSInfo"]) == (expected, expected)


def test_the_master_asks_its_own_member_first(tmp_path: Path) -> None:
    words = machine(tmp_path).master_arguments(("10.0.0.2:2379", "10.0.0.1:2379"))
    assert words[:2] == ["--store", "etcds://10.0.0.1:2379,10.0.0.2:2379"]
    assert "--tls" in words
    assert "--tls" not in machine(tmp_path, tls=False).master_arguments(())


@pytest.mark.parametrize("text", ["", "[]", "name: m1", "a: [", yaml.dump({"name": "m1"})])
def test_other_files_are_no_configuration(tmp_path: Path, text: str) -> None:
    file = tmp_path / "etcd.yaml"
    file.write_text(text)
    with pytest.raises(ClusterError, match=r"etcd\.yaml"):
        read_config(file)


def test_names_that_etcd_cannot_have(tmp_path: Path) -> None:
    for name in ("", "a=b", "a,b", "x" * 64):
        with pytest.raises(ClusterError, match="cannot be a machine's name"):
            machine(tmp_path, name=name)


@pytest.fixture
def strict_umask() -> Iterator[None]:
    before = os.umask(0o077)
    yield
    os.umask(before)


@pytest.mark.usefixtures("strict_umask")
def test_user_of_etcd_can_read_its_configuration_whatever_the_umask_is(tmp_path: Path) -> None:
    first = machine(tmp_path / "state", tls=False)
    first.write({"m1": first.peer_url}, new=True)
    assert stat.S_IMODE(first.config.stat().st_mode) == 0o644
