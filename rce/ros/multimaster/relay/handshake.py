"""The handshake in which both sides of a relay prove that they have the same token. Sans-I/O.

The token itself is never sent. The dialing side proves first, so that an unauthenticated peer learns only a
random number::

    dialing side                                  listening side
    H hello      name, nonce            ------>
                                        <------   N challenge  nonce
    R proof      HMAC over all of it    ------>
                                        <------   H hello      name, HMAC over all of it

Each proof is HMAC-SHA256 with the token as key, over the side that gives it, both nonces and the names that
are known so far.
"""

from __future__ import annotations

import hmac
import json
import secrets

from rce.printable import one_line
from rce.ros.multimaster.errors import LinkBrokenError
from rce.ros.multimaster.relay.frames import PROTOCOL, Challenge, Frame, Hello, Proof

NONCE_BYTES = 32
MAX_NAME = 255
"""Characters of a side's name."""
_DIALING, _LISTENING = "dialing", "listening"


class DialerHandshake:
    """The dialing side's part.

    Args:
        name: Of this side.
        token: What both sides must have.
    """

    def __init__(self, name: str, token: str) -> None:
        self._name = name
        self._token = token
        self.nonce = secrets.token_hex(NONCE_BYTES)
        self._theirs = ""

    def begin(self) -> Hello:
        """Return the first frame to send."""
        return Hello(self._name, self.nonce)

    def prove(self, frame: Frame) -> Proof:
        """Take the challenge; return the answer.

        Raises:
            LinkBrokenError: The other side does not speak this protocol.
        """
        if isinstance(frame, Hello):
            _check_hello(frame)
        if not isinstance(frame, Challenge) or not _is_nonce(frame.nonce):
            raise LinkBrokenError("the other side does not begin with a challenge")
        self._theirs = frame.nonce
        return Proof(_sign(self._token, _DIALING, self.nonce, frame.nonce, self._name))

    def finish(self, frame: Frame) -> str:
        """Take the other side's hello; return its name.

        Raises:
            LinkBrokenError: It has another token.
        """
        if not isinstance(frame, Hello):
            raise LinkBrokenError("the other side does not answer with a hello")
        _check_hello(frame)
        wanted = _sign(self._token, _LISTENING, self.nonce, self._theirs, self._name, frame.name)
        _compare(wanted, frame.proof, frame.name)
        return frame.name


class ListenerHandshake:
    """The listening side's part.

    Args:
        name: Of this side.
        token: What both sides must have.
        own: Nonces of this process's own attempts to dial, which must not come back.
    """

    def __init__(self, name: str, token: str, own: frozenset[str] = frozenset()) -> None:
        self._name = name
        self._token = token
        self._own = own
        self._nonce = secrets.token_hex(NONCE_BYTES)
        self._hello: Hello | None = None

    def challenge(self, frame: Frame) -> Challenge:
        """Take the first frame; return the challenge.

        Raises:
            LinkBrokenError: The other side does not speak this protocol, or is this one.
        """
        if not isinstance(frame, Hello):
            raise LinkBrokenError("the other side does not begin with a hello")
        _check_hello(frame)
        if not _is_nonce(frame.nonce):
            raise LinkBrokenError(f"{frame.name} sends no nonce of {NONCE_BYTES} bytes")
        if frame.nonce in self._own:
            raise LinkBrokenError("the connection comes from this program itself")
        self._hello = frame
        return Challenge(self._nonce)

    def finish(self, frame: Frame) -> tuple[str, Hello]:
        """Take the dialing side's proof.

        Returns:
            The other side's name, and the last frame to send.

        Raises:
            LinkBrokenError: It has another token.
        """
        assert self._hello is not None
        name, nonce = self._hello.name, self._hello.nonce
        if not isinstance(frame, Proof):
            raise LinkBrokenError(f"{name} does not answer the challenge")
        _compare(_sign(self._token, _DIALING, nonce, self._nonce, name), frame.proof, name)
        proof = _sign(self._token, _LISTENING, nonce, self._nonce, name, self._name)
        return name, Hello(self._name, proof=proof)


def _check_hello(hello: Hello) -> None:
    if len(hello.name) > MAX_NAME or one_line(hello.name) != hello.name:
        raise LinkBrokenError("the other side's name is too long or has control characters")
    if hello.protocol != PROTOCOL:
        raise LinkBrokenError(
            f"{hello.name} speaks relay protocol {hello.protocol}, not {PROTOCOL}; update the older rce"
        )


def _compare(wanted: str, given: str, name: str) -> None:
    if not given.isascii() or not hmac.compare_digest(wanted, given):
        raise LinkBrokenError(f"{name} has another token; give both sides the same --relay-token")


def _sign(token: str, *said: str) -> str:
    return hmac.digest(token.encode(errors="surrogateescape"), json.dumps(said).encode(), "sha256").hex()


def _is_nonce(text: str) -> bool:
    return len(text) == 2 * NONCE_BYTES and text.isascii()
