"""What a master says of a number of etcd's members that cannot be highly available."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import cast

import pytest
from support.engine import until
from support.etcd import cluster
from support.masters import MasterProcess

from rce_master.cluster import member_advice
from rce_master.cluster.client import ClusterClient
from rce_master.cluster.member_advice import MemberAdvice
from rce_master.cluster.members import Member
from rce_master.exceptions import StoreError

TWO = "two machines cannot be highly available"


@pytest.mark.needs("etcd")
async def test_a_master_on_two_members_says_what_is_missing(tmp_path: Path) -> None:
    async with cluster(tmp_path / "etcd", 2) as etcd:
        master = MasterProcess(tmp_path, "one", etcd.store, 10.0)
        await master.start(ready="rce-master ready: ")

        async def warned() -> dict[str, object] | None:
            found = await master.health()
            return found if found and TWO in str(found["status"]) else None

        try:
            said = await until(warned, timeout=60, what="it says that a third one is missing")
        finally:
            await master.stop()
        assert (said["ready"], said["role"]) == (True, "leader")
        assert str(said["status"]).startswith("ok; two machines")
        assert TWO in master.output()


async def test_advice_follows_members_that_join(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(member_advice, "LOOK_S", 0.0)
    members: list[Member] = [Member(number, f"m{number}", "", "") for number in range(2)]
    looks = 0

    class Client:
        async def members(self) -> tuple[Member, ...]:
            nonlocal looks
            looks += 1
            if looks % 2:
                raise StoreError("etcd does not answer")
            return tuple(members)

    advice = MemberAdvice(cast("ClusterClient", Client()))
    running = asyncio.create_task(advice.run())
    try:
        await until(lambda: looks > 6, what="it has looked several times")
        assert advice.text.startswith(TWO)
        assert caplog.text.count(TWO) == 1
        members.append(Member(2, "m2", "", ""))
        await until(lambda: not advice.text, what="nothing is missing")
    finally:
        running.cancel()
