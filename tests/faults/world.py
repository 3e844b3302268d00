"""Masters, etcd, task sets and clients that run while faults are made, and the check at the end."""

from __future__ import annotations

import contextlib
import random
import time
from collections import Counter
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass, field
from pathlib import Path

from support.engine import until

from faults.clients import INITIAL, REGISTERS, Clients
from faults.goals import Times
from faults.history import History
from faults.machines import PATIENCE_S, Cluster, Machine, cluster
from faults.seeds import generator
from faults.task_sets import ANSWER, Prober, Robot, running_containers, task_sets, watched_containers

TASK_SETS = 2
"""Real ones."""


@dataclass
class World:
    """What a scenario works with.

    Attributes:
        seed: Of all choices.
        rng: The scenario's own choices.
        scale: 1: as long as in a test run; more: the long run.
        robot: The robot whose links must not be interrupted; None: there are no task sets.
        misplaced: What the container task set does at the end that it should not, or does not do.
    """

    cluster: Cluster
    clients: Clients
    history: History
    times: Times
    seed: int
    scale: float = 1.0
    robot: Robot | None = None
    misplaced: list[str] = field(default_factory=list)
    rng: random.Random = field(init=False)

    def __post_init__(self) -> None:
        self.rng = generator(self.seed, "scenario")

    def rounds(self, count: int) -> int:
        """Return how often to do what the long run of 100 rounds does so many times."""
        return max(1, round(count * self.scale / 100))

    async def until_written(self, what: str, since: float) -> float:
        """Note how long it took until a write was acknowledged that was asked for after a fault."""

        def written() -> float | None:
            self.clients.check()
            return self.history.first_write_after(since)

        end = await until(written, timeout=PATIENCE_S, what=f"a write is acknowledged after: {what}")
        self.times.add(what, end - since)
        return end

    async def until_handed_over(self, former: Machine, since: float, what: str) -> None:
        """Wait until another master leads, and note the longest time without an acknowledged write.

        The former leader may still acknowledge what is asked for after it was told: the first write after it
        would not tell how long the others waited.
        """
        await self.cluster.leader(but=former)
        await self.clients.wait_for_writes()
        pause = self.history.longest_pause(since, time.monotonic())
        self.times.add(what, pause)

    async def until_task_sets_are_back(self, since: float) -> None:
        """Note how long it took until all task sets are connected to the leading master."""
        if self.robot is None:
            return

        async def back() -> bool:
            return await self.connected_task_sets() == TASK_SETS

        await until(back, timeout=PATIENCE_S, what="all task sets are back")
        self.times.add("task sets are back", time.monotonic() - since)

    def is_task_set_answered(self) -> bool:
        """Return whether a master has answered a request of a task set."""
        return any(heard.message == ANSWER for heard in self.history.heard)

    async def connected_task_sets(self) -> int:
        """Return how many real task sets are connected to the leading master."""
        found = await self.clients.machines()
        return sum(there for name, there in found.items() if not name.startswith("prober-"))

    async def until_no_master_leads(self) -> None:
        """Wait until no master says that it leads, and all say why."""

        async def none_leads() -> bool:
            told = [await machine.health() for machine in self.cluster.machines]
            return all(each.get("role") == "standby" and "etcd" in each["status"] for each in told)

        await until(none_leads, timeout=PATIENCE_S, what="no master leads")

    async def whole(self) -> None:
        """Repair everything, and wait until it works."""
        await self.cluster.repair()
        since = time.monotonic()
        await self.clients.wait_for_writes(since=since)
        await self.clients.wait_for_reads(since)
        if self.robot is not None:
            await self.clients.wait_for_a_container()

    async def term(self) -> int:
        """Return the term of the leading master."""

        async def told() -> int:
            return int((await (await self.cluster.leader()).health()).get("term", 0))

        return await until(told, timeout=PATIENCE_S, what="the leading master tells its term")

    @asynccontextmanager
    async def lead_stays(self, fault: str) -> AsyncIterator[None]:
        """Check that no term begins meanwhile.

        Args:
            fault: What is done to the leading master.

        Raises:
            AssertionError: The lead was lost, though that fault must not take it.
        """
        before = await self.term()
        yield
        begun = await self.term() - before
        self.times.add(f"terms begun under {fault}", begun)
        assert begun == 0, f"{begun} terms have begun under {fault}"

    async def until_containers_are_right(self) -> None:
        """Wait until exactly the containers run that were acknowledged and not removed."""
        folder, history = self.cluster.folder, self.history

        def right() -> bool:
            return not history.misplaced(running_containers(folder))

        with contextlib.suppress(AssertionError):
            await until(right, timeout=PATIENCE_S, what="the right containers run")
        self.misplaced = history.misplaced(running_containers(folder))

    async def standby(self) -> Machine:
        """Return a machine whose master does not lead."""
        leader = await self.cluster.leader()
        return self.rng.choice([each for each in self.cluster.machines if each is not leader])


def count_checked(
    times: Times, history: History, stored: list[str], misplaced: list[str], robots: int
) -> None:
    """Note what was checked of a history, and how much of it was wrong."""
    lost = len(list(history.lost(Counter(stored))))
    times.checked("requests, lost or done twice", len(history.made) - lost, lost)
    acts = len(list(history.of_older_terms()))
    times.checked("messages to task sets, by a former leader", len(history.heard) - acts, acts)
    times.checked("reads, not linearizable", history.reads, len(list(history.not_linearizable(INITIAL))))
    times.checked("robots' links, interrupted", robots, len(history.lost_links))
    wrong = len(misplaced) + len(list(history.wrong_containers()))
    times.checked("containers, not as acknowledged", len(history.containers), wrong)


@asynccontextmanager
async def world(
    folder: Path, seed: int, times: Times, *, scale: float = 1.0, robot: bool = True
) -> AsyncIterator[World]:
    """Run everything until it is left; check then what happened.

    Raises:
        AssertionError: Something was lost, done twice or by a master that led no more, or a link was cut; or
            too little was seen to tell.
    """
    history = History()
    async with AsyncExitStack() as stack:
        machines = await stack.enter_async_context(cluster(folder))
        await machines.start()
        clients = Clients(machines, history, seed)
        await clients.prepare()
        made = World(machines, clients, history, times, seed, scale)
        async with AsyncExitStack() as running:
            if robot:
                made.robot = await running.enter_async_context(task_sets(machines, history))
            await running.enter_async_context(Prober(machines, history).running())
            await until(made.is_task_set_answered, timeout=PATIENCE_S, what="a master answers a task set")
            async with AsyncExitStack() as load:
                if robot:
                    await load.enter_async_context(watched_containers(machines.folder, history))
                await load.enter_async_context(clients.under_load(containers=robot))
                if robot:
                    await clients.wait_for_a_container()
                yield made
                ended = time.monotonic()
                await made.whole()
            if robot:
                await made.until_containers_are_right()
        stored = await clients.stored()
        count_checked(times, history, stored, made.misplaced, robots=int(robot))
        violations = [*history.violations(stored, INITIAL), *made.misplaced]
        if made.robot is not None:
            times.add("longest gap of the robot's echo", made.robot.longest_gap)
        assert not violations, f"seed {seed}:\n" + "\n".join(violations)
        unread = sorted(REGISTERS - history.read_since(ended))
        assert not unread, f"not read after the last fault: {', '.join(unread)}"
