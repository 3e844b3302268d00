"""Copies of packages' archives at the other masters: a package is accepted once a majority holds it.

Parts of snapshots of volumes are copied in the same way.

Only the leading master acts. It sends archives to the stand-bys, fetches those that it lacks from them, and
lets them remove those that no package has.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections import Counter
from contextlib import asynccontextmanager, contextmanager, suppress
from errno import EAGAIN
from typing import TYPE_CHECKING, Protocol, TypeAlias

from rce.aio.tasks import BackgroundTasks
from rce_master.exceptions import FencedError, StoreError
from rce_master.leadership.standby_client import StandbyError

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable, Collection, Iterator, Sequence

    from rce_master.leadership.registry import MasterRegistry
    from rce_master.packages.contents import ContentStore
    from rce_master.packages.transfer import ArchiveClient
    from rce_master.store.etcd.layout import OtherMaster

_log = logging.getLogger(__name__)

LOOK_S = 10.0
"""Longest time from one comparison with the other masters to the next."""
WAIT_S = 5.0
"""How long a task set waits for an archive that this master fetches; then it asks again."""
HELD_S = 5.0
"""How long another master may take to list its archives, before those of the others are fetched."""
LOST_S = 900.0
"""A needed archive counts as lost if for so long no other master had it, and all of them answer. After the
engine has been down for days, they get to know each other one by one."""
_PIECE = 1000
"""Archives that are looked at in one turn of the event loop."""


class NeededContents(Protocol):
    """Which archives the state needs. There may be very many: each comparison lists them once."""

    async def look(self) -> None:
        """Read what the other methods need to know; it may have come since the last look."""

    def hashes(self) -> set[str]:
        """Return the hashes of all archives that are needed."""

    def is_needed(self, sha256: str) -> bool:
        """Tell whether one archive is needed, in a time that does not grow with their number."""

    def is_complete(self) -> bool:
        """Tell whether all that is needed is known; else nothing is removed."""


Forget: TypeAlias = "Callable[[Collection[str]], Awaitable[None]]"
"""Makes the state need archives no more, by their hashes."""


class ArchiveCopies:
    """The archives of the leading master, beside those of the others.

    Args:
        store: Where this master keeps archives.
        registry: Knows the other masters.
        client: Asks them.
        noun: What archives are part of, for errors.
    """

    def __init__(
        self, store: ContentStore, registry: MasterRegistry, client: ArchiveClient, *, noun: str = "package"
    ) -> None:
        self._noun = noun
        self._store = store
        self._registry = registry
        self._client = client
        self._tasks = BackgroundTasks()
        self._wanted = asyncio.Event()
        self._removals: dict[tuple[str, str], asyncio.Event] = {}
        """Set when a master has removed an archive, which must not be pushed before: by names, and hashes."""
        self._pushed: Counter[str] = Counter()
        """Hashes of archives that may get a package soon."""
        self._sending: set[tuple[str, str]] = set()
        """Names of masters, and hashes."""
        self._failed: set[str] = set()
        """Names of masters that did not give an archive, or a list of theirs, when they were asked last."""
        self._fetching: dict[str, asyncio.Task[None]] = {}
        self._absent: dict[str, float] = {}
        """Since when no master is known that has a needed archive: hashes, and times."""
        self._lost: set[str] = set()
        """Those of them that count as lost."""
        self._was_alone = False
        """Whether no other master was known when archives were spread last."""
        self._faults: dict[str, str] = {}
        """What was wrong with each master at the last look."""

    def look(self) -> None:
        """Compare with the other masters soon."""
        self._wanted.set()

    async def run(self, needed: NeededContents, forget: Forget | None = None) -> None:
        """Compare with the other masters now and then, until cancelled.

        Args:
            needed: Tells which archives are needed.
            forget: Called with the hashes of needed archives that no master has.

        Raises:
            FencedError: This master leads no more.
        """
        try:
            while True:
                self._wanted.clear()
                await self._compare(needed)
                lost = self._lost
                if lost and forget is not None:
                    await forget(lost)
                try:
                    async with asyncio.timeout(LOOK_S):
                        await self._wanted.wait()
                except TimeoutError:
                    continue
        finally:
            await self._tasks.close()

    # Pushing

    @asynccontextmanager
    async def spread(self, *archives: str) -> AsyncIterator[str]:
        """Copy archives of this master to others; while the block runs, none of them removes any.

        Args:
            archives: Their hashes.

        Yields:
            A warning if no other master is known, so that the archives are on this machine only; else empty.

        Raises:
            StoreError: Too few masters have it; it has to be pushed again.
        """
        self._pushed.update(archives)
        try:
            await self._removed(archives)
            others = await self._registry.others()
            await self._send_to_majority(archives, others)
            yield self._note_alone(is_alone=not others)
        finally:
            self._pushed -= Counter(archives)
            self.look()

    async def _removed(self, archives: Collection[str]) -> None:
        """Wait until no other master is removing any of these archives; each removal is short."""
        for (_, sha256), ended in list(self._removals.items()):
            if sha256 in archives:
                await ended.wait()

    def _note_alone(self, *, is_alone: bool) -> str:
        """Return the warning for the owner of what was spread, and log it once for the operator."""
        warning = (
            f"{self._noun}s are on one machine only, because no other master is known: they are lost with it;"
            " masters that join get them"
        )
        if is_alone and not self._was_alone:
            _log.warning("%s", warning)
        self._was_alone = is_alone
        return warning if is_alone else ""

    async def _send_to_majority(self, archives: Collection[str], others: Sequence[OtherMaster]) -> None:
        missing = (len(others) + 1) // 2  # beside this master
        sent = {
            self._tasks.spawn(self._send(other, archives), name=f"send to {other.name}") for other in others
        }
        reasons = []
        while missing > 0 and sent:
            done, sent = await asyncio.wait(sent, return_when=asyncio.FIRST_COMPLETED)
            for task in done:
                if why := task.result():
                    reasons.append(why)
                else:
                    missing -= 1
        if missing > 0:
            raise StoreError(
                f"a {self._noun} must be on more than half of the {len(others) + 1} masters, and {missing}"
                f" more must take it: {'; '.join(reasons)}; try again later"
            )

    async def _send(self, other: OtherMaster, archives: Collection[str]) -> str:
        """Send archives to a master that may have them; return why it does not."""
        sending = {(other.name, sha256) for sha256 in archives}
        self._sending |= sending
        try:
            held = await self._client.held(other)
            for sha256 in archives:
                if sha256 not in held:
                    await self._client.send(other, sha256, self._store)
        except (StandbyError, FencedError) as error:
            return str(error)
        finally:
            self._sending -= sending
        return ""

    # Fetching

    async def obtain(self, sha256: str) -> None:
        """Fetch an archive from another master, for a task set that waits for it.

        Raises:
            OSError: It is not there yet; the text says why.
        """
        try:
            async with asyncio.timeout(WAIT_S):
                await asyncio.shield(self._fetch(sha256))
        except TimeoutError:
            raise OSError(EAGAIN, "it is being fetched from another master") from None
        except (StoreError, StandbyError) as error:
            raise OSError(EAGAIN, str(error)) from error

    def _fetch(self, sha256: str) -> asyncio.Task[None]:
        """Return the fetch of an archive, of which one runs at a time."""
        task = self._fetching.get(sha256)
        if task is None:
            task = self._tasks.spawn(self._fetch_from_any(sha256), name=f"fetch {sha256}")
            self._fetching[sha256] = task
            task.add_done_callback(lambda done: self._fetched(sha256, done))
        return task

    def _fetched(self, sha256: str, task: asyncio.Task[None]) -> None:
        del self._fetching[sha256]
        if not task.cancelled() and (error := task.exception()) is not None:
            _log.debug("an archive was not fetched: %s", error)

    async def _fetch_from_any(self, sha256: str) -> None:
        reasons = []
        others = await self._registry.others()
        for other in sorted(others, key=lambda one: one.name in self._failed):  # a silent one takes seconds
            try:
                with self._noting_failure(other):
                    await self._client.fetch(other, sha256, self._store)
            except StandbyError as error:
                reasons.append(str(error))
            else:
                _log.info("fetched the archive %s from %s", sha256, other.name)
                return
        raise StandbyError(f"no other master gives the archive: {'; '.join(reasons) or 'there is none'}")

    @contextmanager
    def _noting_failure(self, other: OtherMaster) -> Iterator[None]:
        try:
            yield
        except StandbyError:
            self._failed.add(other.name)
            raise
        self._failed.discard(other.name)

    # Comparing

    async def _compare(self, needed: NeededContents) -> None:
        try:
            others = await self._registry.others()
            own = await asyncio.to_thread(self._store.held)
            why = await self._fetch_missing(needed, others, own)
        except FencedError:
            raise
        except (OSError, StoreError) as error:
            why, others = str(error), []
        self._note("this master", f"packages are incomplete: {why}" if why else "")
        completed = (self._complete(other, needed, own) for other in others)
        for ended in await asyncio.gather(*completed, return_exceptions=True):
            if ended is not None:
                raise ended

    async def _fetch_missing(
        self, needed: NeededContents, others: Sequence[OtherMaster], own: set[str]
    ) -> str:
        """Fetch what this master lacks, and add it to what it has.

        Returns:
            Why not all was fetched; empty if it was.

        Raises:
            StoreError: Archives cannot be kept.
        """
        held: dict[str, set[str]] | None = None
        absent: set[str] = set()
        reasons: dict[str, str] = {}
        while missing := await self._list(needed) - own - reasons.keys():  # what is fetched may name more
            if held is None:
                held = await self._held(others)
            for sha256 in missing:
                if not any(sha256 in there for there in held.values()):
                    absent.add(sha256)
                    reasons[sha256] = "no other master that answers has it"
                    continue
                try:
                    await self._fetch(sha256)
                except StandbyError as error:
                    reasons[sha256] = str(error)
                else:
                    own.add(sha256)
        self._note_absent(absent, all_answered=held is None or len(held) == len(others))
        if not reasons:
            return ""
        example = min(reasons)
        return f"{len(reasons)} are missing, such as {example}: {reasons[example]}"

    async def _held(self, others: Sequence[OtherMaster]) -> dict[str, set[str]]:
        """Return what each of the other masters has that answers soon."""
        held: dict[str, set[str]] = {}

        async def ask(other: OtherMaster) -> None:
            with suppress(StandbyError), self._noting_failure(other):
                held[other.name] = await self._client.held(other, answer_s=HELD_S)

        for ended in await asyncio.gather(*map(ask, others), return_exceptions=True):
            if ended is not None:
                raise ended
        return held

    def _note_absent(self, absent: set[str], *, all_answered: bool) -> None:
        now = time.monotonic()
        self._absent = {sha256: self._absent.get(sha256, now) for sha256 in absent}
        since = now - LOST_S
        self._lost = {one for one, begun in self._absent.items() if begun <= since} if all_answered else set()

    @staticmethod
    async def _list(needed: NeededContents) -> set[str]:
        await needed.look()
        return needed.hashes()

    async def _complete(self, other: OtherMaster, needed: NeededContents, own: set[str]) -> None:
        try:
            await self._make_equal(other, needed, own)
        except StandbyError as error:
            self._note(other.name, f"its packages are not compared: {error}")
        else:
            self._note(other.name, "")

    async def _make_equal(self, other: OtherMaster, needed: NeededContents, own: set[str]) -> None:
        """Send another master what it lacks, and let it remove what no package has."""
        with self._noting_failure(other):
            held = await self._client.held(other)
        listed = await self._list(needed)
        for sha256 in (listed & own) - held:
            if (other.name, sha256) not in self._sending:
                await self._client.send(other, sha256, self._store)
        for number, sha256 in enumerate(held - listed, 1):
            if number % _PIECE == 0:
                await asyncio.sleep(0)
            # Asked again: what is not needed now may have become so since the list was made.
            if sha256 in self._pushed or needed.is_needed(sha256):
                continue
            if not needed.is_complete():
                return
            ended = self._removals[other.name, sha256] = asyncio.Event()
            try:
                await self._client.remove(other, sha256)
            finally:
                del self._removals[other.name, sha256]
                ended.set()

    def _note(self, name: str, fault: str) -> None:
        if fault and fault != self._faults.get(name):
            _log.warning("%s", f"{name}: {fault}")
        self._faults[name] = fault
