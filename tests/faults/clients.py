"""Clients of the masters' REST API that write down what they asked for and what they were answered."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import time
from collections import deque
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from http import HTTPStatus
from typing import Any

import aiohttp
from support.engine import until

from faults.history import Expected, Fate, History
from faults.machines import PATIENCE_S, Cluster, Machine
from faults.seeds import generator
from rce_master.leadership.core import STANDBY_HEADER

USER = "testUser"
REGISTER_USERS = ("registers1", "registers2")
KINDS = ("containers", "slots", "packages")
REGISTERS = frozenset(f"{user}/{kind}" for user in REGISTER_USERS for kind in KINDS)
INITIAL = 1_000_000
"""Of all registers, which are limits of users."""
TIMEOUT_S = 3.0
CONNECT_S = 1.0
"""Until a machine that accepts no connection is passed over; else times would be those of the clients."""
PAUSE_S = 0.1
LAST_ANSWERS = 20
"""Answers that are told if no write is acknowledged in time."""
TOKENS = 1500
"""A user may have 2000."""
CONTAINERS = 3
"""So many run at most that are known to; the oldest is removed for a new one."""
CONTAINER_PAUSE_S = 1.0
_FAILURES = (aiohttp.ClientError, TimeoutError, OSError)


class Clients:
    """Several clients, each of which asks the next master when one does not answer.

    Args:
        cluster: The masters.
        history: Takes what happens.
        seed: Of what they choose.
    """

    def __init__(self, cluster: Cluster, history: History, seed: int) -> None:
        self._urls = [machine.url for machine in cluster.machines]
        self._cluster = cluster
        self._history = history
        self._seed = seed
        self._token = ""
        self._numbers = itertools.count(1)
        self._tasks: list[asyncio.Task[None]] = []
        self._answers: deque[str] = deque(maxlen=LAST_ANSWERS)
        self._may_ask = asyncio.Event()
        self._may_ask.set()
        self._asking = 0

    async def prepare(self) -> None:
        """Log in, and make the users whose limits are the registers."""
        url = (await self._cluster.leader()).url
        credentials = {"userID": USER, "password": USER}
        self._token = (await self._asked("POST", f"{url}api/v1/login", credentials))["token"]
        for name in REGISTER_USERS:
            user = {"name": name, "password": "a password of theirs"}
            await self._asked("POST", f"{url}api/v1/users", user)
            limits = dict.fromkeys(KINDS, INITIAL)
            await self._asked("PATCH", f"{url}api/v1/users/{name}/limits", limits)

    def session(self, timeout: float = TIMEOUT_S) -> aiohttp.ClientSession:
        """Return a session of the logged-in user."""
        headers = {"Authorization": f"Bearer {self._token}"} if self._token else {}
        limit = aiohttp.ClientTimeout(total=timeout, sock_connect=CONNECT_S)
        return aiohttp.ClientSession(headers=headers, timeout=limit, middlewares=(_send_once,))

    async def _asked(self, method: str, url: str, body: object = None) -> dict[str, Any]:
        async with self.session(PATIENCE_S) as session, session.request(method, url, json=body) as reply:
            assert reply.status < 300, await reply.text()
            found: dict[str, Any] = await reply.json() if reply.content_length else {}
            return found

    @asynccontextmanager
    async def under_load(self, *, containers: bool = False) -> AsyncIterator[None]:
        """Write and read all the time.

        Args:
            containers: Make and remove containers, too.
        """
        users = [(name, number) for number, name in enumerate(REGISTER_USERS)]
        tasks = self._tasks = [
            asyncio.create_task(self._make_tokens(0)),
            *(asyncio.create_task(self._write(name, number)) for name, number in users),
            *(asyncio.create_task(self._read(name, number)) for name, number in users),
            *([asyncio.create_task(self._change_containers(0))] if containers else []),
        ]
        try:
            yield
        finally:
            for task in tasks:
                task.cancel()
            results = await asyncio.gather(*tasks, return_exceptions=True)
        for result in results:
            if isinstance(result, Exception):
                raise result

    @asynccontextmanager
    async def paused(self) -> AsyncIterator[None]:
        """Let no client ask for anything; begin when each of them has its answer."""
        self._may_ask.clear()
        try:
            await until(lambda: not self._asking, timeout=PATIENCE_S, what="all clients have their answers")
            yield
        finally:
            self._may_ask.set()

    def check(self) -> None:
        """Check that the clients continue.

        Raises:
            AssertionError: One of them was answered what no client may be.
        """
        for task in self._tasks:
            if task.done():
                assert not task.cancelled(), "a client was cancelled"
                task.result()

    async def wait_for_writes(self, count: int = 3, *, since: float = 0.0) -> None:
        """Wait until so many more writes are acknowledged that were asked for after a time."""
        since = since or time.monotonic()

        def enough() -> bool:
            self.check()
            return sum(start >= since for start, _ in self._history.acknowledged) >= count

        await self._until(enough, f"{count} writes are acknowledged")

    async def wait_for_reads(self, since: float) -> None:
        """Wait until a read of each register is answered that was asked for after a time."""

        def enough() -> bool:
            self.check()
            return self._history.read_since(since) >= REGISTERS

        await self._until(enough, "all registers are read")

    async def wait_for_a_container(self) -> None:
        """Wait until a container is there that a master has acknowledged."""

        def there() -> bool:
            self.check()
            return Expected.RUNS in self._history.containers.values()

        await self._until(there, "a container is made")

    async def _until(self, condition: Callable[[], bool], what: str) -> None:
        try:
            await until(condition, timeout=PATIENCE_S, what=what)
        except AssertionError as error:
            raise AssertionError("\n".join([f"{error}; clients were answered:", *self._answers])) from error

    async def stored(self) -> list[str]:
        """Return the robots of all tokens."""
        url = (await self._cluster.leader()).url
        found = await self._asked("GET", f"{url}api/v1/robot-tokens")
        return [token["robot"] for token in found["tokens"]]

    async def machines(self) -> dict[str, bool]:
        """Return the task sets, and whether they are connected."""
        url = (await self._cluster.leader()).url
        found = await self._asked("GET", f"{url}api/v1/machines")
        return {each["process"]: each["connected"] for each in found["machines"]}

    async def drain(self, machine: Machine, *, drained: bool) -> None:
        """Let a master lead only if no other one does, or let it lead again."""
        url = (await self._cluster.leader()).url
        method = "PUT" if drained else "DELETE"
        found = await self._asked(method, f"{url}api/v1/machines/{machine.name}/drain")
        assert [master["drained"] for master in found["masters"]] == [drained], found

    async def check_refusal(self, machine: Machine) -> None:
        """Check that a master without a lead refuses a write, and says when to ask again."""
        url, body = f"{machine.url}api/v1/robot-tokens", {"robot": "refused"}
        async with self.session() as session, session.post(url, json=body) as reply:
            told = reply.status, reply.headers.get("Retry-After")
            assert told == (HTTPStatus.SERVICE_UNAVAILABLE, "1"), await reply.text()

    @asynccontextmanager
    async def events(self) -> AsyncIterator[list[int]]:
        """Follow all events until it is left; yield their ids, which grow longer meanwhile."""
        ids: list[int] = []
        following = asyncio.create_task(self._follow_events(ids))
        try:
            yield ids
        finally:
            following.cancel()
            results = await asyncio.gather(following, return_exceptions=True)
        for result in results:
            if isinstance(result, Exception):
                raise result

    async def _follow_events(self, ids: list[int]) -> None:
        for used in itertools.count():
            headers = {"Last-Event-ID": str(ids[-1])} if ids else {}
            with contextlib.suppress(*_FAILURES):
                async with (
                    self.session(PATIENCE_S) as session,
                    session.get(f"{self._url(used)}api/v1/events", headers=headers) as reply,
                ):
                    number = 0
                    async for line in reply.content:
                        if line.startswith(b"id:"):
                            number = int(line[3:])
                        elif line.startswith(b"data:"):  # else it is the id after which the stream begins
                            ids.append(number)
            await asyncio.sleep(PAUSE_S)

    async def _make_tokens(self, used: int) -> None:
        async with self.session() as session:
            for number in range(TOKENS):
                robot, start = f"robot{number}", time.monotonic()
                self._history.made[robot] = Fate.UNKNOWN
                url = f"{self._url(used)}api/v1/robot-tokens"
                fate, _ = await self._ask(session, "POST", url, {"robot": robot})
                self._history.made[robot] = fate
                if fate is Fate.DONE:
                    self._history.acknowledged.append((start, time.monotonic()))
                else:
                    used += 1
                await asyncio.sleep(PAUSE_S)

    async def _change_containers(self, used: int) -> None:
        known = self._history.containers
        async with self.session() as session:
            for number in itertools.count():
                there = [name for name, expected in known.items() if expected is not Expected.GONE]
                if len(there) >= CONTAINERS:
                    url = f"{self._url(used)}api/v1/containers/{there[0]}"
                    used += not await self._change(session, there[0], "DELETE", url)
                name = f"box{number}"
                known[name] = Expected.GONE
                url = f"{self._url(used)}api/v1/containers"
                used += not await self._change(session, name, "POST", url, {"tag": name})
                await asyncio.sleep(CONTAINER_PAUSE_S)

    async def _change(
        self, session: aiohttp.ClientSession, name: str, method: str, url: str, body: object = None
    ) -> bool:
        """Make or remove a container; return whether a leading master answered."""
        before, known = self._history.containers[name], self._history.containers
        known[name] = Expected.EITHER  # if the test ends meanwhile, too
        fate, _ = await self._ask(session, method, url, body)
        self._history.changed_container(name, before, fate, made=method == "POST")
        return fate in (Fate.DONE, Fate.MISSING)

    async def _write(self, user: str, used: int) -> None:
        rng = generator(self._seed, user)
        async with self.session() as session:
            while True:
                kind, value, start = rng.choice(KINDS), next(self._numbers), time.monotonic()
                url, fate = f"{self._url(used)}api/v1/users/{user}/limits", Fate.UNKNOWN
                try:
                    fate, _ = await self._ask(session, "PATCH", url, {kind: value})
                finally:  # also when the test ends meanwhile
                    self._history.wrote(f"{user}/{kind}", start, time.monotonic(), value, fate)
                used += fate is not Fate.DONE
                await asyncio.sleep(PAUSE_S)

    async def _read(self, user: str, used: int) -> None:
        async with self.session() as session:
            while True:
                start = time.monotonic()
                fate, found = await self._ask(session, "GET", f"{self._url(used)}api/v1/users/{user}")
                if fate is Fate.DONE:
                    for kind in KINDS:
                        value = int(found["limits"][kind]["limit"])
                        self._history.read(f"{user}/{kind}", start, time.monotonic(), value)
                used += 1  # each master in turn, so that one that leads no more is asked too
                await asyncio.sleep(PAUSE_S)

    def _url(self, used: int) -> str:
        return self._urls[used % len(self._urls)]

    async def _ask(
        self, session: aiohttp.ClientSession, method: str, url: str, body: object = None
    ) -> tuple[Fate, dict[str, Any]]:
        await self._may_ask.wait()
        self._asking += 1
        try:
            async with session.request(method, url, json=body) as reply:
                if reply.status < 300:
                    return Fate.DONE, await reply.json() if reply.content_length else {}
                if reply.status == HTTPStatus.NOT_FOUND and method == "DELETE":
                    return Fate.MISSING, {}
                text = await reply.text()
                assert reply.status in {500, 502, 503}, (reply.status, text)
                self._answers.append(f"{method} {url}: {reply.status} {text}")
                if STANDBY_HEADER in reply.headers:
                    return Fate.NOT_DONE, {}
        except _FAILURES as error:
            self._answers.append(f"{method} {url}: {error!r}")
        finally:
            self._asking -= 1
        return Fate.UNKNOWN, {}


async def _send_once(
    request: aiohttp.ClientRequest, send: aiohttp.ClientHandlerType
) -> aiohttp.ClientResponse:
    """Send a request once: aiohttp would repeat a DELETE whose connection is lost, which may be done then."""
    try:
        return await send(request)
    except aiohttp.ClientConnectionError as error:
        raise aiohttp.ClientConnectionError(repr(error)) from error
