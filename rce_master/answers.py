"""Answers to requests with an ``Idempotency-Key``: sealed for the store, found again, and opened.

What is kept must not help a reader of the store. So a request, which may hold a password, is kept as a keyed
hash, and an answer, which may hold a token, is encrypted. Both keys come from the engine's secret, which is
not in the store, and from the ``Idempotency-Key``, of which the store has a plain hash only.
"""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import hmac
import secrets
from dataclasses import dataclass
from typing import TYPE_CHECKING

from rce_master.exceptions import ConflictError, InvalidRequestError, UnderWayError
from rce_master.state import commands
from rce_master.state.answers import is_over
from rce_master.state.user_records import KeptAnswer, kept_answer_key

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from rce_master.state.tables import Tables
    from rce_master.state_service import StateService

PURPOSE = "answers to repeated requests"
"""Of the key that is derived from the engine's secret."""
FORGET_EVERY_S = 60.0
_NONCE = 12
"""Bytes, as AES-GCM has them."""


@dataclass(frozen=True, slots=True)
class KeyedRequest:
    """A request with an ``Idempotency-Key``."""

    user: str
    key: str
    content: bytes
    """Its method, path, query and body: a repeat has the same."""

    @property
    def digest(self) -> str:
        """What is kept of the key."""
        return hashlib.sha256(self.key.encode()).hexdigest()

    @property
    def id(self) -> str:
        """The key of its answer in the table."""
        return kept_answer_key(self.user, self.digest)


@dataclass(frozen=True, slots=True)
class Answer:
    """What a request was answered with."""

    status: int
    body: bytes
    """JSON; empty: none."""


class Answers:
    """The answers that are kept, and the requests with a key that are under way.

    Args:
        tables: The state's tables, to read from.
        secret: Known to the masters only.
        clock: Seconds since 1970.
    """

    def __init__(self, tables: Tables, secret: bytes, clock: Callable[[], float]) -> None:
        self._tables = tables
        self._secret = secret
        self._clock = clock
        self._under_way: set[str] = set()

    @contextlib.contextmanager
    def under_way(self, request: KeyedRequest) -> Iterator[Answer | None]:
        """Give the answer that the request got before, if it was done; else no other one with its key begins.

        Raises:
            UnderWayError: One with its key is under way.
            InvalidRequestError: The key was used for another request.
            ConflictError: The kept answer cannot be read.
        """
        if request.id in self._under_way:
            raise UnderWayError
        kept = self._tables.answers.get(request.id)
        if kept is not None and not is_over(kept, self._clock()):
            yield self._open(request, kept)
            return
        self._under_way.add(request.id)
        try:
            yield None
        finally:
            self._under_way.discard(request.id)

    def seal(self, request: KeyedRequest, answer: Answer) -> KeptAnswer:
        """Return what is kept of an answer."""
        key = self._key(request)
        return KeptAnswer(
            user=request.user,
            digest=request.digest,
            created=self._clock(),
            status=answer.status,
            mark=_mark(key),
            request=_hash(key, request),
            body=_encrypt(key, request, answer.body) if answer.body else b"",
        )

    def _open(self, request: KeyedRequest, kept: KeptAnswer) -> Answer:
        key = self._key(request)
        if not hmac.compare_digest(kept.mark, _mark(key)):
            raise ConflictError(
                "a request with this Idempotency-Key was done, and its answer cannot be read since the"
                " engine's secret was changed; look what it did"
            )
        if not hmac.compare_digest(kept.request, _hash(key, request)):
            raise InvalidRequestError(
                "Idempotency-Key: it was used for another request; use a new key for each new request"
            )
        return Answer(kept.status, _decrypt(key, request, kept.body) if kept.body else b"")

    def _key(self, request: KeyedRequest) -> bytes:
        return hmac.digest(self._secret, f"{request.user}\n{request.key}".encode(), "sha256")

    async def run(self, state_service: StateService) -> None:
        """Forget old answers again and again, until cancelled."""
        while True:
            await asyncio.sleep(FORGET_EVERY_S)
            while True:
                oldest = next(iter(self._tables.answers), None)
                now = self._clock()
                if oldest is None or not is_over(oldest, now):
                    break
                (fault,) = await state_service.submit_all([commands.ForgetAnswers(now=now)])
                if fault is not None:
                    break


@dataclass(frozen=True, slots=True)
class PendingAnswer:
    """Keeps the answer to one request, with what the request does."""

    answers: Answers
    request: KeyedRequest
    status: int
    """Of its success."""

    def with_answer(self, command: commands.Command, body: bytes) -> commands.Once:
        """Return a command that also keeps the answer.

        Args:
            command: What the request does.
            body: Of the answer.
        """
        return commands.Once(
            command=command, answer=self.answers.seal(self.request, Answer(self.status, body))
        )


def _mark(key: bytes) -> str:
    """Return what tells whether an answer was sealed by this key."""
    return hmac.digest(key, b"mark", "sha256").hex()[:16]


def _hash(key: bytes, request: KeyedRequest) -> str:
    return hmac.digest(key, b"request " + request.content, "sha256").hex()


def _encrypt(key: bytes, request: KeyedRequest, body: bytes) -> bytes:
    from cryptography.hazmat.primitives.ciphers.aead import AESGCM  # takes memory; few answers have bodies

    nonce = secrets.token_bytes(_NONCE)
    return nonce + AESGCM(key).encrypt(nonce, body, request.id.encode())


def _decrypt(key: bytes, request: KeyedRequest, sealed: bytes) -> bytes:
    from cryptography.exceptions import InvalidTag
    from cryptography.hazmat.primitives.ciphers.aead import AESGCM

    try:
        return AESGCM(key).decrypt(sealed[:_NONCE], sealed[_NONCE:], request.id.encode())
    except InvalidTag as error:
        raise ConflictError(
            "a request with this Idempotency-Key was done, and its stored answer is damaged; look what it did"
        ) from error
