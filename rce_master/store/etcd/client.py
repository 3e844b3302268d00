"""A client of etcd's JSON gateway with several endpoints, which are asked in turn."""

from __future__ import annotations

import asyncio
import contextlib
import io
import json
import logging
import time
from typing import TYPE_CHECKING, Self, TypeVar

import aiohttp

from rce.services.etcd import MIN_VERSION
from rce.tls import explain_to_client
from rce_master.exceptions import StoreError
from rce_master.store.etcd import wire
from rce_master.store.etcd.attempts import Attempts, FailedError, connect_text, not_etcd
from rce_master.store.etcd.exceptions import QUORUM, EtcdAwayError, EtcdRefusedError, NoQuorumError

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Container, Sequence
    from types import TracebackType

    from rce.tls import Context

T = TypeVar("T")

_log = logging.getLogger(__name__)

ATTEMPT_S = 1.0
"""How long one member may take for a small request before the next one is asked."""
WATCH_BUFFER = 1 << 20
"""Bytes of a watch that are read ahead."""
LOAD_S = 20.0
"""The same for a page of a table."""
BYTES_PER_S = 100_000
"""How fast a member takes a request at least. Its gateway reads JSON slowly, and a request that is given up
before it was read is not done."""
_OK = 200
_CANCELLED, _UNKNOWN, _DEADLINE, _EXHAUSTED, _INTERNAL, _UNAVAILABLE = 1, 2, 4, 8, 13, 14
_UNCERTAIN = frozenset((_CANCELLED, _UNKNOWN, _DEADLINE, _INTERNAL, _UNAVAILABLE))
"""gRPC's codes after which a request may have been done."""
_BUSY = "too many requests"
_ERROR = b'"error"'
"""What answers hold that tell of a fault; keys and values of records are in base64."""


class Watch:
    """What etcd tells of a watch, line by line.

    Args:
        member: The number of the member that is watched.

    Attributes:
        content: Of the answer.
        member: The number of the member.
        is_given_up: Whether the next watch asks another member.
    """

    content: aiohttp.StreamReader

    def __init__(self, member: int) -> None:
        self.member = member
        self.is_given_up = False
        self._read = bytearray()
        self._looked = 0
        """Bytes without the end of a line."""

    def give_up(self) -> None:
        """Let the next watch ask another member."""
        self.is_given_up = True

    async def next(self, timeout: float) -> wire.Watched | None:
        """Return what comes next; None: nothing within a time.

        Args:
            timeout: Seconds.

        Raises:
            WireError: The watch has ended.
            ClientError: The connection broke.
        """
        try:
            async with asyncio.timeout(timeout):
                while (end := self._read.find(b"\n", self._looked)) < 0:
                    self._looked = len(self._read)
                    piece = await self.content.readany()
                    if not piece:
                        raise wire.WireError("it ended the watch")
                    self._read += piece
        except TimeoutError:
            return None
        line = bytes(self._read[: end + 1])
        del self._read[: end + 1]
        self._looked = 0
        return wire.read_watched(line)


class EtcdClient:
    """Speaks with the members of one etcd cluster. An async context manager.

    A member that fails or is late is passed over, and the next one stays in use; calls that wait for the
    member that failed ask the next one too, and take the answer that comes first. Cancelling a call leaves
    open whether it is done.

    Args:
        endpoints: Addresses ``HOST:PORT`` of members; the nearest one first.
        tls: Gives the TLS context of each connection, with this master's certificate; None speaks plainly.
        attempt: Seconds that one member may take for a small request; a large one gets more.

    Example:
        ```python
        async with EtcdClient(["10.0.0.1:2379", "10.0.0.2:2379"]) as etcd:
            await etcd.check_members()
            page = await etcd.range("/rce/")
        ```
    """

    def __init__(
        self, endpoints: Sequence[str], *, tls: Context | None = None, attempt: float = ATTEMPT_S
    ) -> None:
        if not endpoints:
            raise ValueError("give the address of at least one member of etcd")
        self._endpoints = tuple(endpoints)
        self._tls = tls
        self._attempt = attempt
        self._current = 0
        self._unanswered: set[asyncio.Timeout] = set()
        """Of the calls that wait for the first byte of an answer from the member in use."""
        self._session: aiohttp.ClientSession | None = None

    def __str__(self) -> str:
        return ",".join(self._endpoints)

    @property
    def in_use(self) -> str:
        """``HOST:PORT`` of the member that answered last, which is asked first."""
        return self._endpoints[self._current]

    async def __aenter__(self) -> Self:
        # The members are named by the operator; a proxy of the environment is for other addresses.
        connector = aiohttp.TCPConnector(limit=0, keepalive_timeout=60.0)
        # With Accept, etcd logs of each request that it ignores the name in the certificate.
        self._session = aiohttp.ClientSession(
            connector=connector, trust_env=False, skip_auto_headers=("Accept",)
        )
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._session is not None:
            await self._session.close()
            self._session = None

    async def check_members(self) -> None:
        """Check that etcd is there, new enough, and has a quorum.

        Raises:
            StoreError: It is not; the text says what is wrong and what to do.
        """
        answers = await asyncio.gather(*map(self._check_version, self._endpoints), return_exceptions=True)
        reasons = {}
        for number, error in enumerate(answers):
            if isinstance(error, FailedError):
                reasons[number] = f"{self._endpoints[number]}: {error}"
            elif error is not None:
                raise error
        if len(reasons) == len(self._endpoints):
            raise EtcdAwayError([*reasons.values()], maybe_done=False)
        for reason in reasons.values():
            _log.warning("a member of etcd cannot be used: %s", reason)
        while self._current in reasons:
            self._current = (self._current + 1) % len(self._endpoints)
        try:
            await self.get("/")
        except EtcdAwayError as error:
            raise NoQuorumError(f"etcd has no quorum ({error}): {QUORUM}") from error

    async def _check_version(self, endpoint: str) -> None:
        try:
            async with asyncio.timeout(self._attempt):
                body = await self._exchange(endpoint, "version", None)
        except TimeoutError:
            text = f"no answer within {self._attempt:.3g} s"
            raise FailedError(text, maybe_done=False) from None
        try:
            version = wire.read_version(body)
        except wire.WireError:
            raise FailedError(
                "this is not etcd; expected its address for clients, as a rule port 2379", maybe_done=False
            ) from None
        if version < MIN_VERSION:
            found, needed = (".".join(map(str, one)) for one in (version, MIN_VERSION))
            raise StoreError(f"etcd at {endpoint} is version {found}; version {needed} or later is needed")

    # Keys

    async def get(self, key: str) -> wire.Record | None:
        """Read a key, as a majority knows it; None if it does not exist.

        Raises:
            EtcdRefusedError: etcd refused.
            EtcdAwayError: No member answered.
        """
        page = await self._call("v3/kv/range", wire.get_request(key), wire.read_page)
        return page.records[0] if page.records else None

    async def range(
        self,
        prefix: str,
        *,
        after: str = "",
        limit: int = 0,
        revision: int = 0,
        keys_only: bool = False,
        written_after: int = 0,
        timeout: float | None = None,
    ) -> wire.Page:
        """Read keys with a prefix, in their order.

        ``timeout`` is the seconds that one member may take; None: as long as for any small request. The other
        arguments are those of :func:`wire.range_request`.

        Raises:
            EtcdRefusedError: etcd refused; with the code ``OUT_OF_RANGE`` the revision was compacted away.
            EtcdAwayError: No member answered.
        """
        request = wire.range_request(
            prefix,
            after=after,
            limit=limit,
            revision=revision,
            keys_only=keys_only,
            written_after=written_after,
        )
        return await self._call("v3/kv/range", request, wire.read_page, timeout)

    async def transact(
        self,
        conditions: Sequence[wire.Condition],
        operations: Sequence[wire.Put | wire.Delete],
        otherwise: Sequence[str] = (),
    ) -> wire.Outcome:
        """Do a transaction, or read keys if its conditions do not hold.

        After an :class:`EtcdAwayError` with ``maybe_done`` it may have been done, also some time later.

        Raises:
            EtcdRefusedError: etcd refused, and did nothing.
            EtcdAwayError: No member answered.
        """
        request = wire.txn_request(conditions, operations, otherwise)
        return await self._call("v3/kv/txn", request, wire.read_outcome)

    @contextlib.asynccontextmanager
    async def watch(self, prefix: str, revision: int) -> AsyncIterator[Watch]:
        """Watch keys with a prefix at the member in use.

        Args:
            prefix: How they begin.
            revision: The first one to tell of.

        Raises:
            EtcdAwayError: It cannot be reached, or ended the watch; the next call asks another member.
        """
        assert self._session is not None
        used = self._current
        endpoint = self._endpoints[used]
        watch = Watch(used)
        try:
            async with asyncio.timeout(self._attempt):  # etcd begins its answer before there is a change
                response = await self._session.post(
                    f"{'http' if self._tls is None else 'https'}://{endpoint}/v3/watch",
                    json=wire.watch_request(prefix, revision),
                    timeout=aiohttp.ClientTimeout(total=None),
                    ssl=True if self._tls is None else self._tls(),
                    allow_redirects=False,
                    read_bufsize=WATCH_BUFFER,
                )
            async with response:
                watch.content = response.content
                yield watch
        except TimeoutError:
            watch.give_up()
            text = f"no answer within {self._attempt:.3g} s"
            raise EtcdAwayError([f"{endpoint}: {text}"], maybe_done=False) from None
        except (aiohttp.ClientError, OSError, wire.WireError) as error:
            watch.give_up()
            text = explain_to_client(error) or str(error) or type(error).__name__
            raise EtcdAwayError([f"{endpoint}: {text}"], maybe_done=False) from error
        finally:
            if watch.is_given_up:
                self._pass_over(used)

    def uses(self, watch: Watch) -> bool:
        """Return whether requests go to the member of a watch; if not, it has failed since."""
        return watch.member == self._current

    # Leases

    async def grant(self, ttl: int) -> tuple[int, int]:
        """Make a lease.

        Args:
            ttl: Seconds; etcd may make it longer.

        Returns:
            Its number and its seconds.

        Raises:
            EtcdRefusedError: etcd refused.
            EtcdAwayError: No member answered; a lease that was made nevertheless ends by itself.
        """
        return await self._call("v3/lease/grant", wire.grant_request(ttl), wire.read_lease)

    async def renew(self, lease: int) -> int:
        """Renew a lease.

        Returns:
            The seconds that it lasts from now; 0 if it has ended.

        Raises:
            EtcdRefusedError: etcd refused.
            EtcdAwayError: No member answered.
        """
        return (await self._call("v3/lease/keepalive", wire.lease_request(lease), wire.read_lease))[1]

    async def revoke(self, lease: int, timeout: float | None = None) -> None:
        """End a lease, and with it its keys.

        Args:
            lease: Its number.
            timeout: Seconds that one member may take; None: as long as for any small request.

        Raises:
            EtcdRefusedError: etcd refused; the code ``NOT_FOUND`` says that the lease has ended.
            EtcdAwayError: No member answered.
        """
        await self._call("v3/lease/revoke", wire.lease_request(lease), wire.as_it_is, timeout)

    async def faults(self) -> tuple[str, ...]:
        """Return the faults of the cluster that the member in use knows; it asks no other member.

        Raises:
            EtcdRefusedError: etcd refused.
            EtcdAwayError: No member answered.
        """
        return await self._call("v3/maintenance/status", {}, wire.read_faults)

    # Requests

    async def _call(
        self,
        path: str,
        message: wire.Message,
        read: Callable[[wire.Message], T],
        timeout: float | None = None,
    ) -> T:
        """Ask the endpoints in turn, each once, and return the first answer.

        One that is late may still answer while the next one is asked: where all of them are far away, the
        first request is the first that can be answered.
        """
        body = json.dumps(message).encode()
        limit = (timeout or self._attempt) + len(body) / BYTES_PER_S
        reasons: dict[int, str] = {}
        maybe_done = False
        async with Attempts() as attempts:
            while len(reasons) < len(self._endpoints):
                used = self._next_of(reasons)
                endpoint = self._endpoints[used]
                late = asyncio.timeout(limit)
                began = time.monotonic()
                attempts.begin(used, self._exchange(endpoint, path, body, late))
                try:
                    async with late:
                        self._unanswered.add(late)
                        while used not in reasons:
                            asked, answer = await attempts.next()
                            try:
                                return read(json.loads(answer.result()))
                            except (wire.WireError, ValueError) as error:
                                reasons[asked] = f"{self._endpoints[asked]}: {error}"
                                maybe_done = True
                            except FailedError as error:
                                reasons[asked] = f"{self._endpoints[asked]}: {error}"
                                maybe_done = maybe_done or error.maybe_done
                            except EtcdRefusedError as error:
                                # Another member may have passed the same request on, or be about to.
                                if not maybe_done and not attempts.are_left:
                                    raise
                                told = [*reasons.values(), str(error)]
                                raise EtcdAwayError(told, maybe_done=True) from error
                except TimeoutError:
                    # Another call that passes the member over ends this one before its limit.
                    waited = min(time.monotonic() - began, limit)
                    reasons[used] = f"{endpoint}: no answer within {waited:.3g} s"
                    maybe_done = True
                finally:
                    self._unanswered.discard(late)
                self._pass_over(used)
        raise EtcdAwayError([*reasons.values()], maybe_done=maybe_done)

    def _next_of(self, asked: Container[int]) -> int:
        """Return the first member, from the one in use on, that was not asked yet."""
        count = len(self._endpoints)
        order = ((self._current + step) % count for step in range(count))
        return next(number for number in order if number not in asked)

    def _pass_over(self, used: int) -> None:
        """Use the next member, unless another call has done so, and let no call wait for this one."""
        if used != self._current or len(self._endpoints) == 1:
            return
        self._current = (used + 1) % len(self._endpoints)
        unanswered, self._unanswered = self._unanswered, set()
        for one in unanswered:
            if not one.expired():
                one.reschedule(asyncio.get_running_loop().time())

    async def _exchange(
        self,
        endpoint: str,
        path: str,
        body: bytes | None,
        late: asyncio.Timeout | None = None,
    ) -> bytes:
        """Do one request at one endpoint.

        Args:
            endpoint: Its address.
            path: Of the request.
            body: What is posted; None: nothing, it is a ``GET``.
            late: Ends the wait for it; not for the reason that its member was passed over, once an answer
                begins.
        """
        assert self._session is not None
        scheme = "http" if self._tls is None else "https"
        try:
            async with self._session.request(
                "GET" if body is None else "POST",
                f"{scheme}://{endpoint}/{path}",
                data=None if body is None else io.BytesIO(body),  # aiohttp sends it in pieces
                timeout=aiohttp.ClientTimeout(total=None, sock_connect=self._attempt),
                ssl=True if self._tls is None else self._tls(),
                allow_redirects=False,
            ) as response:
                if late is not None:
                    self._unanswered.discard(late)
                status, answer = response.status, await response.read()
        except aiohttp.ClientConnectorError as error:
            raise FailedError(connect_text(error), maybe_done=False) from error
        except aiohttp.ConnectionTimeoutError:
            raise FailedError(f"no connection within {self._attempt:.3g} s", maybe_done=False) from None
        except (aiohttp.ClientError, OSError) as error:
            text = explain_to_client(error) or str(error) or type(error).__name__
            if self._tls is None and isinstance(error, aiohttp.ServerDisconnectedError):
                text += " (if this etcd uses TLS, name it etcds://)"
            raise FailedError(text, maybe_done=True) from error
        if status == _OK and _ERROR not in answer:
            return answer
        fault = wire.read_fault(answer)
        if fault is None:
            raise FailedError(not_etcd(status, answer, tls=self._tls is not None), maybe_done=False)
        if fault.code in _UNCERTAIN:
            raise FailedError(fault.text, maybe_done=True)
        if fault.code == _EXHAUSTED and _BUSY in fault.text:
            raise FailedError(fault.text, maybe_done=False)
        raise EtcdRefusedError(endpoint, fault)
