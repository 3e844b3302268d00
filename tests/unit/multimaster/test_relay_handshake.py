"""How the two sides of a relay prove that they have the same token."""

from __future__ import annotations

import pytest

from rce.ros.multimaster.errors import LinkBrokenError, MultimasterError
from rce.ros.multimaster.relay.frames import MAX_GREETING, Decoder, Frame, Hello, Ping, Proof, encode
from rce.ros.multimaster.relay.handshake import MAX_NAME, DialerHandshake, ListenerHandshake
from rce.ros.multimaster.relay.link import check_listening
from rce.ros.multimaster.sync import SyncSettings


def greet(dialing: DialerHandshake, listening: ListenerHandshake) -> tuple[str, str]:
    """Do a whole handshake by way of the wire.

    Returns:
        What each side takes the other's name to be.
    """

    def sent(frame: Frame) -> Frame:
        (received,) = Decoder(MAX_GREETING).feed(b"".join(encode(frame)))
        return received

    challenge = listening.challenge(sent(dialing.begin()))
    name, hello = listening.finish(sent(dialing.prove(sent(challenge))))
    return dialing.finish(sent(hello)), name


@pytest.mark.parametrize("token", ["", "secret", "\u00fc" * 100])
def test_handshake_tells_both_names(token: str) -> None:
    assert greet(DialerHandshake("robot", token), ListenerHandshake("cloud", token)) == ("cloud", "robot")


def test_token_is_in_no_frame() -> None:
    dialing, listening = DialerHandshake("robot", "secret"), ListenerHandshake("cloud", "secret")
    begin = dialing.begin()
    challenge = listening.challenge(begin)
    proof = dialing.prove(challenge)
    _, hello = listening.finish(proof)
    frames = (begin, challenge, proof, hello)
    assert b"secret" not in b"".join(piece for frame in frames for piece in encode(frame))


def test_dialer_with_another_token_learns_nothing() -> None:
    """The side that listens has given away a random number when it refuses."""
    with pytest.raises(
        LinkBrokenError, match="robot has another token; give both sides the same --relay-token"
    ):
        greet(DialerHandshake("robot", "wrong"), ListenerHandshake("cloud", "secret"))


def test_listener_with_another_token_is_refused() -> None:
    dialing = DialerHandshake("robot", "secret")
    listening, liar = ListenerHandshake("cloud", "secret"), ListenerHandshake("cloud", "wrong")
    begin = dialing.begin()
    dialing.prove(listening.challenge(begin))
    challenge = liar.challenge(begin)
    _, hello = liar.finish(DialerHandshake.prove(_with_nonce(begin.nonce, "wrong"), challenge))
    with pytest.raises(LinkBrokenError, match="cloud has another token"):
        dialing.finish(hello)


def _with_nonce(nonce: str, token: str) -> DialerHandshake:
    found = DialerHandshake("robot", token)
    found.nonce = nonce
    return found


def test_recorded_proof_is_of_no_use() -> None:
    dialing, listening = DialerHandshake("robot", "secret"), ListenerHandshake("cloud", "secret")
    begin = dialing.begin()
    recorded = dialing.prove(listening.challenge(begin))
    another = ListenerHandshake("cloud", "secret")
    another.challenge(begin)
    with pytest.raises(LinkBrokenError, match="another token"):
        another.finish(recorded)


@pytest.mark.parametrize("proof", ["", "\ud800", "\u00fc" * 64, "0" * 63])
def test_proof_that_is_no_digest_is_a_wrong_one(proof: str) -> None:
    dialing, listening = DialerHandshake("robot", "secret"), ListenerHandshake("cloud", "secret")
    challenge = listening.challenge(dialing.begin())
    with pytest.raises(LinkBrokenError, match="robot has another token"):
        listening.finish(Proof(proof))
    dialing.prove(challenge)
    with pytest.raises(LinkBrokenError, match="cloud has another token"):
        dialing.finish(Hello("cloud", proof=proof))


@pytest.mark.parametrize("name", ["x" * (MAX_NAME + 1), "a\nb", "\x1b[31mred"])
def test_name_that_cannot_be_logged_is_refused(name: str) -> None:
    """It comes from a peer that has not proved anything, and goes to the log."""
    with pytest.raises(LinkBrokenError, match="name is too long or has control characters"):
        ListenerHandshake("cloud", "secret").challenge(DialerHandshake(name, "secret").begin())


def test_token_from_the_environment_may_be_any_bytes() -> None:
    token = b"\xff\xfe".decode(errors="surrogateescape")
    assert greet(DialerHandshake("robot", token), ListenerHandshake("cloud", token)) == ("cloud", "robot")


def test_own_connection_is_refused() -> None:
    """Who is dialed could hand our own proof back to us."""
    dialing = DialerHandshake("robot", "secret")
    with pytest.raises(LinkBrokenError, match="from this program itself"):
        ListenerHandshake("robot", "secret", frozenset({dialing.nonce})).challenge(dialing.begin())


def test_older_protocol_is_refused_by_both_sides() -> None:
    """It sent the token to every client that connected."""
    older = Hello("old", protocol=1)
    with pytest.raises(LinkBrokenError, match="old speaks relay protocol 1, not 3; update the older rce"):
        ListenerHandshake("cloud", "secret").challenge(older)
    with pytest.raises(LinkBrokenError, match="protocol 1"):
        DialerHandshake("robot", "secret").prove(older)


@pytest.mark.parametrize("frame", [Ping(), Hello("x"), Hello("x", "short"), Proof("x")])
def test_listener_wants_a_hello_with_a_nonce(frame: Frame) -> None:
    with pytest.raises(LinkBrokenError):
        ListenerHandshake("cloud", "secret").challenge(frame)


def test_long_greeting_is_refused_before_it_is_kept() -> None:
    with pytest.raises(LinkBrokenError, match="a frame of"):
        list(Decoder(MAX_GREETING).feed(b"".join(encode(Hello("x" * MAX_GREETING)))))


@pytest.mark.parametrize(("host", "token"), [("127.0.0.1", ""), ("::1", ""), ("", "t"), ("10.0.0.1", "t")])
def test_relay_listens_with_token_or_on_loopback(host: str, token: str) -> None:
    check_listening(host, token)


@pytest.mark.parametrize("host", ["", "0.0.0.0", "10.0.0.1", "::"])
def test_relay_beyond_loopback_wants_a_token(host: str) -> None:
    with pytest.raises(MultimasterError, match="need a token: give --relay-token"):
        SyncSettings(relay_listen=0, relay_addr=host)
