"""Hubs: their sockets, and connections that are handed over."""

from __future__ import annotations

import asyncio
import contextlib
import os
import socket
import stat
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
import uvloop

from rce.aio.backoff import Backoff
from rce.control.model import LinkAddress
from rce.link import LinkHub, LinkTimeouts
from rce.link.frames import Frame, FrameType, encode
from rce.link.handover import HandoverReceiver, HandoverSender, LinkAcceptor
from rce.link.handshake import encode_hello

if TYPE_CHECKING:
    from .conftest import Rig

TIMEOUTS = LinkTimeouts(redial=Backoff(0.005, 1.0, jitter=0.5))
TOPIC_OUT = ("SubscriberConverter", "PublisherInterface")
TOPIC_IN = ("PublisherConverter", "SubscriberInterface")
SERVICE_OUT = ("ServiceProviderForwarder", "ServiceClientInterface")


async def test_unix_socket_is_private_and_removed(folder: Path) -> None:
    path = folder / "hub"
    hub = LinkHub("here")
    await hub.listen_unix(path)
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    other = LinkHub("here")
    with pytest.raises(OSError, match="another process listens"):
        await other.listen_unix(path)
    await hub.close()
    assert not path.exists()
    await other.close()


async def test_socket_file_of_a_dead_process_is_replaced(folder: Path) -> None:
    path = folder / "hub"
    with socket.socket(socket.AF_UNIX) as dead:
        dead.bind(str(path))
    hub = LinkHub("here")
    await hub.listen_unix(path)
    reader, writer = await asyncio.open_unix_connection(str(path))
    writer.write(bytes(24))
    assert await reader.read() == b""
    writer.close()
    await hub.close()


async def test_other_files_are_not_replaced(folder: Path) -> None:
    path = folder / "file"
    path.write_text("precious")
    hub = LinkHub("here")
    with pytest.raises(FileExistsError):
        await hub.listen_unix(path)
    await hub.close()
    assert path.read_text() == "precious"
    path.unlink()


async def test_socket_file_of_a_successor_is_kept(folder: Path) -> None:
    path = folder / "hub"
    hub = LinkHub("here")
    await hub.listen_unix(path)
    path.rename(folder / "moved")
    successor = LinkHub("here")
    await successor.listen_unix(path)
    await hub.close()
    assert path.exists()
    await successor.close()
    (folder / "moved").unlink()


async def test_closed_hub_ends_its_links(rig: Rig, way: str) -> None:
    a, b = await rig.pair(way)
    await rig.join(a, b, [TOPIC_OUT])
    await a.connected(1)
    if way == "local":
        await b.endpoint.close()
    else:
        await b.hub.close()
    await a.connected()


async def test_bad_socket_is_not_adopted(rig: Rig) -> None:
    hub = await rig.hub()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock, pytest.raises((OSError, ValueError)):
        await hub.adopt(sock, b"")
    one, other = socket.socketpair()
    other.close()
    await hub.adopt(one, encode_hello("L", "x"))


async def test_sockets_may_be_made_elsewhere(rig: Rig) -> None:
    path = rig.path()
    listening = socket.socket(socket.AF_UNIX)
    listening.bind(str(path))
    accepting = await rig.hub()
    await accepting.listen_socket(listening)
    asked: list[LinkAddress] = []

    async def dial(address: LinkAddress) -> socket.socket:
        asked.append(address)
        if len(asked) == 1:
            raise ConnectionError("not yet")
        sock = socket.socket(socket.AF_UNIX)
        sock.connect(address.unix)
        return sock

    dialing = LinkHub("elsewhere", TIMEOUTS, dial=dial)
    rig.stack.push_async_callback(dialing.close)
    a, b = rig.party("a", dialing), rig.party("b", accepting)
    b.address = LinkAddress(machine="here", unix=str(path))
    await rig.join(a, b, [TOPIC_OUT])
    await a.connected(1)
    assert asked == [b.address] * 2
    path.unlink()


async def test_many_connections_are_handed_over_in_a_burst() -> None:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    got: dict[int, bytes] = {}
    complete = asyncio.Event()

    async def adopt(sock: socket.socket, received: bytes) -> None:
        with sock:
            assert not os.get_inheritable(sock.fileno())
            got[sock.getpeername()[1]] = received
        if len(got) == 200:
            complete.set()

    sender, receiver = HandoverSender(ours), HandoverReceiver(theirs, adopt)
    acceptor = LinkAcceptor()
    port = await acceptor.listen("127.0.0.1", 0)
    await acceptor.assign(sender, [f"L{n}" for n in range(200)])
    writers = {}
    for n in range(200):
        _, writer = await asyncio.open_connection("127.0.0.1", port)
        hello = encode_hello(f"L{n}", "t")
        writer.write(hello[:30])
        writers[writer.get_extra_info("sockname")[1]] = (writer, hello)
    for writer, hello in writers.values():
        writer.write(hello[30:] + encode(Frame(FrameType.PING)))
    await complete.wait()
    assert got == {port: hello for port, (_, hello) in writers.items()}
    for writer, _ in writers.values():
        writer.close()
    await acceptor.close()
    await receiver.close()
    sender.close()


async def test_what_was_just_handed_over_is_closed_with_the_receiver() -> None:
    """Nothing has taken it yet; what is not a connection is left alone."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)

    async def adopt(sock: socket.socket, received: bytes) -> None:
        pytest.fail(f"it was adopted with {received!r}")

    sender, receiver = HandoverSender(ours), HandoverReceiver(theirs, adopt)
    near, far = socket.socketpair()
    near.setblocking(False)
    with near, far, Path(os.devnull).open() as file:
        await sender.send(file, b"no connection")  # type: ignore[arg-type]
        await sender.send(far, b"hello")
        far.close()
        receiver._read()
        await receiver.close()
        assert near.recv(1) == b""
    sender.close()


async def test_receiver_learns_that_the_sender_is_gone() -> None:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    ended = asyncio.Event()
    hub = LinkHub("here")
    receiver = HandoverReceiver(theirs, hub.adopt, on_end=ended.set)
    HandoverSender(ours).close()
    await ended.wait()
    await receiver.close()
    await hub.close()


async def test_forgotten_process_gets_no_more_connections(rig: Rig) -> None:
    acceptor = LinkAcceptor()
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    sender = HandoverSender(ours)
    await acceptor.assign(sender, ["A", "B"])
    await acceptor.assign(sender, ["B"])
    assert list(acceptor._routes) == ["B"]
    acceptor.forget(sender)
    assert not acceptor._routes
    sender.close()
    theirs.close()
    await acceptor.close()


@pytest.fixture(scope="session")
def used_uvloop() -> None:
    """Let uvloop make the descriptors that it keeps for the life of the process."""
    uvloop.run(asyncio.sleep(0))


@pytest.mark.usefixtures("used_uvloop")
def test_links_work_under_uvloop(way: str, folder: Path) -> None:
    """The programs run under uvloop; the other tests do not."""
    from contextlib import AsyncExitStack

    from .conftest import Rig

    async def run() -> None:
        async with AsyncExitStack() as stack:
            rig = Rig(stack, folder)
            a, b = await rig.pair(way)
            await rig.join(a, b, [TOPIC_OUT, TOPIC_IN, SERVICE_OUT])
            await a.connected(1, 2, 3)
            await b.connected(1, 2, 3)
            for size in (3, 5_000, 5_000_000):
                a.fakes["i1"].port.send(bytes(size))
                b.fakes["i2"].port.send(bytes(size))
                assert await b.fakes["i1"].received.get() == (bytes(size), False)
                assert await a.fakes["i2"].received.get() == (bytes(size), False)
                assert await a.fakes["i3"].port.call(b"a" * size) == b"A" * size

    uvloop.run(run())


@pytest.mark.parametrize("steps", range(5))
async def test_acceptor_that_ends_closes_new_connections(steps: int) -> None:
    """However far the event loop has come with a connection when the acceptor closes."""
    acceptor = LinkAcceptor(TIMEOUTS)
    port = await acceptor.listen("127.0.0.1", 0)
    with socket.create_connection(("127.0.0.1", port)) as client:
        for _ in range(steps):
            await asyncio.sleep(0)
        await acceptor.close()
        client.setblocking(False)
        with contextlib.suppress(ConnectionResetError):
            assert await asyncio.wait_for(asyncio.get_running_loop().sock_recv(client, 1), 10) == b""
