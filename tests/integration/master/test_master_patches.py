"""A real master with task sets of this release and of the one before, and over a restart of the master."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

from rce.control.desired import DesiredState, Fit
from rce.control.messages import PatchSpec, PatchStatus, Put, Sync, TaskSetKind
from rce.control.model import PATCHES, EndpointState, EndpointStatus, StatusPatch
from rce_master.auth import client_digest
from rce_master.store import MemoryStore

if TYPE_CHECKING:
    from integration.master.conftest import RunSite, Site, TaskSet

NEW = (PATCHES,)


def outside(tag: str) -> dict[str, Any]:
    return {"tag": tag, "type": "SubscriberConverter", "cls": "std_msgs/String"}


def inside(tag: str) -> dict[str, Any]:
    return {"tag": tag, "type": "PublisherInterface", "cls": "std_msgs/String", "addr": f"/{tag}"}


async def join(site: Site, tag: str) -> None:
    await site.api("POST", "/endpoints/rob/interfaces", outside(tag), status=204)
    await site.api("POST", "/endpoints/c/interfaces", inside(tag), status=204)
    await site.api("POST", "/connections", {"tag_a": f"rob/{tag}", "tag_b": f"c/{tag}"}, status=204)


async def follow(task_set: TaskSet, desired: DesiredState, connections: int) -> None:
    """Take patches until so many connections are desired."""
    while len(desired.connections) < connections:
        patch = (await task_set.get(PatchSpec)).patch
        if desired.fit(patch) is not Fit.OLD:
            assert desired.fit(patch) is Fit.NEXT
            desired.patch(patch)


async def test_task_sets_of_both_releases_are_told_the_same(run_site: RunSite) -> None:
    store = MemoryStore()
    robots = TaskSetKind.ROBOT
    async with (
        run_site(store) as site,
        site.task_set(robots, "r1", url="ws://r1/", features=NEW) as new,
        site.containers("c1") as old,
    ):
        await site.api("POST", "/containers", {"tag": "c"}, status=204)
        assert (await new.channel.login("testUser", "rob", client_digest("testUser"))).status == 200
        await join(site, "a")
        desired = DesiredState((await new.get(Put)).endpoint)
        await follow(new, desired, 1)
        await join(site, "b")
        await follow(new, desired, 2)
        put = await old.get(Put)
        while len(put.endpoint.connections) < 2:
            put = await old.get(Put)
        assert {one.tag for one in put.endpoint.interfaces} == {"a", "b"}
        assert set(desired.interfaces) == {"a", "b"}
        assert not any(isinstance(message, PatchSpec) for message in old.taken)
    async with run_site(store) as site:
        made = site.task_set(robots, "r1", url="ws://r1/", features=NEW)
        async with made as new:
            new.channel.send(PatchStatus(patch=StatusPatch(status=status(1))))  # of nothing that is known
            await asyncio.sleep(0)
            shown = (await site.api("GET", "/interfaces", user="testUser"))["interfaces"]
            assert [one["tag"] for one in shown if one["endpoint"] == "c"] == ["a", "b"]


def status(number: int) -> EndpointStatus:
    return EndpointStatus(id="testUser/rob", revision=1, state=EndpointState.RUNNING, number=number)


async def test_a_sync_is_the_base_of_the_next_patch(run_site: RunSite) -> None:
    async with run_site() as site, site.containers("c0") as first:
        await site.api("POST", "/containers", {"tag": "c"}, status=204)
        await first.get(Put)
        await site.api("POST", "/endpoints/c/interfaces", inside("a"), status=204)
        await first.get(Put)
    async with run_site() as site, site.task_set(TaskSetKind.CONTAINER, "c1", features=NEW) as new:
        await site.api("POST", "/containers", {"tag": "c"}, status=204)
        desired = DesiredState((await new.get(Put)).endpoint)
        await site.api("POST", "/endpoints/c/interfaces", inside("a"), status=204)
        patch = (await new.get(PatchSpec)).patch
        assert (patch.base, [one.tag for one in patch.interfaces]) == (desired.revision, ["a"])
        desired.patch(patch)
        new.endpoints = (
            EndpointStatus(id="testUser/c", revision=desired.revision, state=EndpointState.RUNNING),
        )
        new.channel._abort("the network broke")
        (spec,) = (await new.get(Sync)).endpoints
        assert spec.revision >= desired.revision
        await site.api("POST", "/endpoints/c/interfaces", inside("b"), status=204)
        patch = (await new.get(PatchSpec)).patch
        assert (patch.base, [one.tag for one in patch.interfaces]) == (spec.revision, ["b"])
