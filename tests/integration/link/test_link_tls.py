"""Links by TCP in TLS: what passes on the wire, and what is refused."""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import logging
import os
import socket
import ssl
from typing import TYPE_CHECKING

import pytest
from msgspec.structs import replace

from rce.control.model import LinkAddress, LinkSpec
from rce.link import LinkHub, LinkLimits
from rce.link.encryption import _derive, accepting_context, dialing_context
from rce.link.exceptions import LinkLostError, LinkRefusedError
from rce.link.handshake import encode_hello, encode_secure
from rce.link.link import Link
from rce.link.secure import accept_secure

from .conftest import TIMEOUTS

if TYPE_CHECKING:
    from collections.abc import Callable

    from rce.link.socket_carrier import SocketCarrier

    from .conftest import Rig

SECURE = pytest.mark.parametrize("way", ["secure", "handed-over-secure"])
TOPIC_OUT = ("SubscriberConverter", "PublisherInterface")
TOKEN = "the token of the link"


class Tap:
    """A TCP proxy that keeps all that passes."""

    def __init__(self) -> None:
        self.seen = bytearray()

    async def open(self, rig: Rig, port: int) -> int:
        async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            onward, back = await asyncio.open_connection("127.0.0.1", port)
            async with asyncio.TaskGroup() as tasks:
                tasks.create_task(self._copy(reader, back))
                tasks.create_task(self._copy(onward, writer))

        server = await asyncio.start_server(serve, "127.0.0.1", 0)
        rig.stack.callback(server.close)
        found: int = server.sockets[0].getsockname()[1]
        return found

    async def _copy(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            while data := await reader.read(1 << 16):
                self.seen += data
                writer.write(data)
                await writer.drain()
        except ConnectionError:
            pass
        finally:
            writer.close()


@pytest.mark.parametrize("way", ["tcp", "secure", "handed-over-secure"])
async def test_payload_and_token_do_not_cross_in_clear(rig: Rig, way: str) -> None:
    """The same look at a plain link finds both, so it would find them."""
    a, b = await rig.pair(way)
    tap = Tap()
    port = await tap.open(rig, b.address.port)
    b.address = LinkAddress(machine="", host="127.0.0.1", port=port, tls=b.address.tls)
    await rig.join(a, b, [TOPIC_OUT])
    await a.connected(1)
    a.fakes["i1"].port.send(b"a payload in clear " * 2000)
    payload, _ = await asyncio.wait_for(b.fakes["i1"].received.get(), 10)
    assert payload == b"a payload in clear " * 2000
    clear = way == "tcp"
    assert (b"a payload in clear" in tap.seen) == clear
    assert (b'"secret"' in tap.seen) == clear, "the token"
    assert len(tap.seen) > len(payload)


@pytest.mark.parametrize("way", ["secure", "handed-over-secure", "handed-over"])
async def test_peer_without_the_token_is_refused(
    rig: Rig, way: str, caplog: pytest.LogCaptureFixture
) -> None:
    """One line in the log, no traceback, and nothing is kept of its connection at either end."""
    _, b = await rig.pair(way)
    a = rig.party("a", await rig.hub())
    await rig.join(a, b, [TOPIC_OUT])
    await a.connected(1)
    stranger = await rig.hub()
    address = replace(b.address, tls=True)
    spec = LinkSpec(id="L", peer="u/b", token="another", dial=True, address=address)
    with caplog.at_level(logging.INFO), pytest.raises((OSError, LinkLostError)):
        await stranger.connect(spec)
    async with asyncio.timeout(60):
        while not any("no TLS with the peer" in record.getMessage() for record in caplog.records):
            await asyncio.sleep(0.01)
    assert not any(record.exc_info for record in caplog.records)
    assert a.endpoint.connections == (1,), "the link itself continues"
    async with asyncio.timeout(60):
        while stranger._carriers or len(b.hub._carriers) > 1:
            await asyncio.sleep(0.01)


@SECURE
async def test_plain_peer_with_the_token_is_refused(rig: Rig, way: str) -> None:
    a, b = await rig.pair(way)
    await rig.join(a, b, [TOPIC_OUT])
    await a.connected(1)
    reader, writer = await asyncio.open_connection("127.0.0.1", b.address.port)
    writer.write(encode_hello("L", "secret"))
    answer = await asyncio.wait_for(reader.read(), 10)
    assert b"in TLS only" in answer
    writer.close()


@SECURE
async def test_silent_peer_has_one_time_for_tls_and_hello(
    rig: Rig, way: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A limit that began again after TLS would be the long one."""
    _, b = await rig.pair(way, handshake=0.5)
    spec = LinkSpec(id="L", peer="u/a", token=TOKEN, dial=False, address=LinkAddress())
    b.hub.register(Link(spec, LinkLimits()))

    async def begin_tls(sock: socket.socket, spec: LinkSpec, make: Callable[[], SocketCarrier]) -> None:
        b.hub.timeouts = dataclasses.replace(b.hub.timeouts, handshake=600.0)
        await accept_secure(sock, spec, make)

    monkeypatch.setattr("rce.link.hub.accept_secure", begin_tls)
    sock = socket.create_connection(("127.0.0.1", b.address.port))
    sock.sendall(encode_secure("L"))
    sock.setblocking(False)
    async with asyncio.timeout(20):
        with contextlib.suppress(ConnectionError, ssl.SSLError):
            tls = dialing_context(TOKEN)
            reader, writer = await asyncio.open_connection(sock=sock, ssl=tls, server_hostname="")
            with contextlib.closing(writer):
                assert await reader.read() == b""


async def test_hub_with_tls_does_not_dial_plain_peers(rig: Rig) -> None:
    _, b = await rig.pair("tcp")
    strict = LinkHub("here", TIMEOUTS, tls=True)
    rig.stack.push_async_callback(strict.close)
    spec = LinkSpec(id="L", peer="u/b", token="secret", dial=True, address=b.address)
    with pytest.raises(LinkRefusedError, match="takes links without TLS only; start its program with --tls"):
        await strict.connect(spec)


async def test_unknown_link_is_refused(rig: Rig, caplog: pytest.LogCaptureFixture) -> None:
    _, b = await rig.pair("secure", unknown_link=0.01)
    reader, writer = await asyncio.open_connection("127.0.0.1", b.address.port)
    writer.write(encode_secure("nobody's"))
    with caplog.at_level(logging.WARNING):
        assert await asyncio.wait_for(reader.read(), 10) == b""
    assert 'unknown link "nobody\'s"' in caplog.text
    writer.close()


@pytest.mark.parametrize("answerer", ["the accepting end", "the dialing end"])
def test_an_end_is_not_answered_by_its_own_key(answerer: str) -> None:
    """Both know the token; but who dials wants the accepting end's key, so reflections fail."""
    served = accepting_context(TOKEN)
    if answerer == "the dialing end":  # as a server would show it
        served = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        show_dialing_key(served)
    to_server, to_client = ssl.MemoryBIO(), ssl.MemoryBIO()
    client = dialing_context(TOKEN).wrap_bio(to_client, to_server)
    server = served.wrap_bio(to_server, to_client, server_side=True)
    if answerer == "the dialing end":
        with pytest.raises(ssl.SSLCertVerificationError):
            _finish(client, server)
    else:
        _finish(client, server)


def _finish(*ends: ssl.SSLObject) -> None:
    waiting = list(ends)
    while waiting:
        for end in list(waiting):
            try:
                end.do_handshake()
                waiting.remove(end)
            except ssl.SSLWantReadError:
                continue


def show_dialing_key(context: ssl.SSLContext) -> None:
    certificate, key = _derive(TOKEN, dialing=True)
    descriptor = os.memfd_create("test")
    try:
        os.write(descriptor, certificate + key)
        context.load_cert_chain(f"/proc/self/fd/{descriptor}")
    finally:
        os.close(descriptor)
