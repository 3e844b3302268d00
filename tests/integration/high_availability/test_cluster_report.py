"""What ``rce cluster status`` finds out when most members of etcd have just failed."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest
from support.etcd import cluster
from support.ports import free_port

from rce_master.cluster.client import LIST_S, ClusterClient
from rce_master.cluster.joining import cluster_client
from rce_master.cluster.report import make_report
from rce_master.store.etcd.exceptions import EtcdAwayError

pytestmark = pytest.mark.needs("etcd")


async def test_leader_that_does_not_know_its_loss_yet_is_reported(tmp_path: Path) -> None:
    """It says that it leads for about a second, and answers nothing that needs the others."""
    async with cluster(tmp_path / "etcd", 3) as made:
        leader = await made.leader()
        others = [member for member in made.members if member is not leader]
        async with ClusterClient([leader.endpoint], attempt=5.0) as client:
            for member in others:
                member.send(signal.SIGKILL)
            report = await make_report(client, None, free_port())
    assert not report.ok
    assert {line.name: line.role for line in report.members if line.role == "away"} == {
        member.name: "away" for member in others
    }
    (advice,) = report.advice
    assert advice.startswith("etcd has no quorum, ")
    assert f"Answering: {leader.name}; away: " in advice


async def test_member_that_answered_is_asked_first(tmp_path: Path) -> None:
    """Each request to a silent one before it, such as this machine's own, would take seconds more."""
    async with cluster(tmp_path / "etcd", 3) as made:
        silent, *others = made.members
        silent.send(signal.SIGSTOP)
        try:
            async with await cluster_client(made.endpoints, None) as client:
                assert client.in_use in [member.endpoint for member in others]
            with pytest.raises(EtcdAwayError, match=f"no answer within {LIST_S:g} s"):
                await cluster_client([silent.endpoint], None)
        finally:
            silent.send(signal.SIGCONT)
