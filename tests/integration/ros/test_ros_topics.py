"""Topics between our nodes through our core."""

from __future__ import annotations

import asyncio

import pytest
from support.ros_nodes import MakeNode, collect

from rce.ros.core import Core
from rce.ros.errors import MasterUnreachableError, NodeClosedError, TypeMismatchError
from rce.ros.node import Node, Publisher
from rce.ros.node.input_link import HeaderReader
from rce.ros.tcpros.header import encode_header
from rce.ros.types import Message, TypeRegistry
from rce.ros.xmlrpc import RpcClient

STRING = "std_msgs/String"


@pytest.mark.parametrize("size", [0, 3, 65531, 65532, 65536, 131072, 1_000_000, 10_000_000, 20_000_000])
async def test_messages_of_any_size(make_node: MakeNode, size: int) -> None:
    async with make_node("a") as a, make_node("b") as b:
        received: asyncio.Queue[tuple[bytes, bool]] = asyncio.Queue()
        await b.subscribe_serialized(
            "t", STRING, lambda payload, latched: received.put_nowait((payload, latched))
        )
        publisher = await a.advertise("t", STRING)
        await publisher.wait_for_subscribers(timeout=10)
        payload = publisher.type.serialize({"data": "x" * size})
        for body in (payload, publisher.type.serialize({"data": "small"}), payload):
            publisher.publish_serialized(body)
            assert await asyncio.wait_for(received.get(), 20) == (body, False)


async def test_publisher_is_asked_again_whether_it_latches(make_node: MakeNode) -> None:
    """It said that it does not, before its first message; each message comes once, in order."""
    async with make_node("a") as a, make_node("b") as b:
        received: asyncio.Queue[tuple[bytes, bool]] = asyncio.Queue()
        await b.subscribe_serialized("t", STRING, lambda *message: received.put_nowait(message))
        publisher = await a.advertise("t", STRING)
        await publisher.wait_for_subscribers(timeout=10)
        payloads = [publisher.type.serialize({"data": str(number)}) for number in range(5)]
        for payload in payloads:
            publisher.publish_serialized(payload, latch=True)
        async with asyncio.timeout(20):
            assert [await received.get() for _ in payloads] == [(payload, True) for payload in payloads]
            later: asyncio.Queue[tuple[bytes, bool]] = asyncio.Queue()
            await b.subscribe_serialized("t", STRING, lambda *message: later.put_nowait(message))
            assert await later.get() == (payloads[-1], True)
            while publisher.connections > 1:
                await asyncio.sleep(0.01)
        assert received.empty()


async def test_publisher_that_ends_while_it_is_asked_loses_no_message(
    make_node: MakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(HeaderReader, "frame_received", lambda *_: None)  # it waits for ever
    async with make_node("b") as b:
        received: asyncio.Queue[tuple[bytes, bool]] = asyncio.Queue()
        await b.subscribe_serialized("t", STRING, lambda *message: received.put_nowait(message))
        async with make_node("a") as a:
            publisher = await a.advertise("t", STRING)
            await publisher.wait_for_subscribers(timeout=10)
            publisher.publish(data="last words")
            async with asyncio.timeout(20):
                while publisher.connections < 2:
                    await asyncio.sleep(0.01)
        payload, _ = await asyncio.wait_for(received.get(), 20)
        assert payload[4:] == b"last words"


async def test_many_messages_arrive_whole_and_in_order(make_node: MakeNode) -> None:
    async with make_node("a") as a, make_node("b") as b:
        subscriber = await b.subscribe("t", STRING, queue_size=5000)
        publisher = await a.advertise("t", STRING, queue_size=5000)
        await publisher.wait_for_subscribers(timeout=10)
        sent = [str(number) * (number % 300) for number in range(3000)]
        for text in sent:
            publisher.publish(data=text)
        assert await collect(subscriber, len(sent)) == sent
        assert publisher.dropped == subscriber.dropped == 0


async def test_a_latched_message_reaches_later_subscribers(make_node: MakeNode) -> None:
    async with make_node("a") as a, make_node("b") as b:
        publisher = await a.advertise("t", STRING, latch=True)
        publisher.publish(data="old")
        publisher.publish(data="new")
        received: asyncio.Queue[tuple[bytes, bool]] = asyncio.Queue()
        await b.subscribe_serialized(
            "t", "*", lambda payload, latched: received.put_nowait((payload, latched))
        )
        assert await asyncio.wait_for(received.get(), 10) == (b"\x03\0\0\0new", True)


async def test_latched_message_reaches_second_subscriber_of_node(make_node: MakeNode) -> None:
    """A latched message reaches a second subscriber of the same node."""
    async with make_node("a") as a, make_node("b") as b:
        publisher = await a.advertise("t", STRING, latch=True)
        publisher.publish(data="kept")
        assert await collect(await b.subscribe("t", STRING), 1) == ["kept"]
        assert await collect(await b.subscribe("t", STRING), 1) == ["kept"]


async def test_one_message_can_be_latched(make_node: MakeNode) -> None:
    async with make_node("a") as a, make_node("b") as b:
        publisher = await a.advertise("t", STRING)
        publisher.publish_serialized(b"\x04\0\0\0kept", latch=True)
        publisher.publish_serialized(b"\x04\0\0\0gone")
        assert await collect(await b.subscribe("t", STRING), 1) == ["kept"]


async def test_many_publishers_and_subscribers(make_node: MakeNode) -> None:
    async with make_node("a") as a, make_node("b") as b, make_node("c") as c, make_node("d") as d:
        publishers = [await node.advertise("t", STRING) for node in (a, b)]
        subscribers = [await node.subscribe("t", STRING) for node in (c, d)]
        second = await c.subscribe("t", STRING)
        for publisher in publishers:
            await publisher.wait_for_subscribers(2, timeout=10)
            publisher.publish(data=publisher.topic)
        for subscriber in (*subscribers, second):
            assert await collect(subscriber, 2) == ["/t", "/t"]
        await subscribers[0].wait_for_publishers(2, timeout=10)


async def test_a_node_hears_itself(make_node: MakeNode) -> None:
    async with make_node("a") as a:
        subscriber = await a.subscribe("t", STRING)
        publisher = await a.advertise("t", STRING)
        await publisher.wait_for_subscribers(timeout=10)
        publisher.publish(data="echo")
        assert await collect(subscriber, 1) == ["echo"]


async def test_names_are_resolved_and_remapped(core: Core, make_node: MakeNode) -> None:
    argv = ["t:=/other", "__name:=renamed"]
    async with make_node("a", namespace="ns", argv=argv) as a, make_node("b") as b:
        await a.advertise("t", STRING)
        await a.advertise("~private", STRING)
        await a.advertise("relative", STRING)
        assert a.name == "/ns/renamed"
        topics = set(core.graph.topic_types)
        assert topics == {"/rosout", "/other", "/ns/renamed/private", "/ns/relative"}
        assert b.name == "/b"


async def test_callbacks_are_called_in_order_and_may_fail(
    make_node: MakeNode, caplog: pytest.LogCaptureFixture
) -> None:
    async with make_node("a") as a, make_node("b") as b:
        seen: list[str] = []
        done = asyncio.Event()

        async def slowly(message: Message) -> None:
            text = message.data
            await asyncio.sleep(0.02 if text == "0" else 0)
            seen.append(text)
            if text == "1":
                raise RuntimeError("as planned")
            if text == "3":
                done.set()

        await b.subscribe("t", STRING, slowly)
        publisher = await a.advertise("t", STRING)
        await publisher.wait_for_subscribers(timeout=10)
        for number in range(4):
            publisher.publish(data=str(number))
        await asyncio.wait_for(done.wait(), 10)
        assert seen == ["0", "1", "2", "3"]
        assert "as planned" in caplog.text


async def test_stalled_subscriber_loses_its_oldest_messages(make_node: MakeNode) -> None:
    """A subscriber that stops reading loses its own oldest messages."""
    async with make_node("a") as a, make_node("quick") as quick, RpcClient() as rpc:
        publisher = await a.advertise("t", STRING, queue_size=3)
        good = await quick.subscribe("t", STRING)
        _, _, (_, host, port) = await rpc.call(a.uri, "requestTopic", ("/stalled", "/t", [["TCPROS"]]))
        reader, writer = await asyncio.open_connection(host, port)
        writer.write(encode_header({"callerid": "/stalled", "topic": "/t", "type": STRING, "md5sum": "*"}))
        await publisher.wait_for_subscribers(2, timeout=10)
        body = "x" * 2_000_000
        for number in range(30):
            publisher.publish(data=f"{number} {body}")
            assert [text.split()[0] for text in await collect(good, 1)] == [str(number)]
        assert publisher.dropped > 10
        publisher.publish(data="last ")
        found: list[str] = []
        assert await read_frame(reader)  # the header
        while not found or found[-1] != "last":
            found.append((await read_frame(reader))[4:].decode().split(" ")[0])
        assert found[0] == "0"
        assert found[-3:] == ["28", "29", "last"]
        assert len(found) < 20
        writer.close()
        await writer.wait_closed()


async def read_frame(reader: asyncio.StreamReader) -> bytes:
    async with asyncio.timeout(60):
        return await reader.readexactly(int.from_bytes(await reader.readexactly(4), "little"))


async def test_a_slow_program_loses_its_oldest_messages(make_node: MakeNode) -> None:
    async with make_node("a") as a, make_node("b") as b:
        kept = await b.subscribe("t", STRING, queue_size=2)
        all_of_them = await b.subscribe("t", STRING, queue_size=100)
        publisher = await a.advertise("t", STRING)
        await publisher.wait_for_subscribers(timeout=10)
        for number in range(10):
            publisher.publish(data=str(number))
        await collect(all_of_them, 10)
        assert await collect(kept, 2) == ["8", "9"]
        assert kept.dropped == 8


async def test_queue_size_zero_drops_nothing(make_node: MakeNode) -> None:
    """As in roscpp and rospy, 0 asks for a queue without a bound in messages."""
    async with make_node("a") as a, make_node("b") as b:
        subscriber = await b.subscribe("t", STRING, queue_size=0)
        publisher = await a.advertise("t", STRING, queue_size=0)
        await publisher.wait_for_subscribers(timeout=10)
        text = "x" * 1000
        for _ in range(500):
            publisher.publish(data=text)
        assert await collect(subscriber, 500) == [text] * 500
        assert publisher.dropped == subscriber.dropped == 0
        with pytest.raises(ValueError, match="queue_size is -1"):
            await a.advertise("other", STRING, queue_size=-1)


async def test_subscribers_follow_a_publisher_that_comes_back(make_node: MakeNode) -> None:
    async with make_node("b") as b:
        subscriber = await b.subscribe("t", STRING)
        for incarnation in ("first", "second"):
            async with make_node("a") as a:
                publisher = await a.advertise("t", STRING)
                await publisher.wait_for_subscribers(timeout=10)
                publisher.publish(data=incarnation)
                assert await collect(subscriber, 1) == [incarnation]


async def test_a_lost_connection_is_made_again(make_node: MakeNode) -> None:
    async with make_node("a") as a, make_node("b") as b:
        subscriber = await b.subscribe("t", STRING)
        publisher = await a.advertise("t", STRING)
        await publisher.wait_for_subscribers(timeout=10)
        link = a._topics.outputs["/t"].links[0]
        link.connection.abort()
        await link.connection.gone.wait()
        assert publisher.connections == 0
        await publisher.wait_for_subscribers(timeout=10)
        publisher.publish(data="again")
        assert await collect(subscriber, 1) == ["again"]


async def test_types_must_agree(core: Core, make_node: MakeNode, caplog: pytest.LogCaptureFixture) -> None:
    async with make_node("a") as a, make_node("b") as b:
        publisher = await a.advertise("t", STRING)
        with pytest.raises(TypeMismatchError):
            await a.advertise("t", "std_msgs/Bool")
        wrong = await b.subscribe("t", "std_msgs/Bool")
        with pytest.raises(TypeMismatchError):
            await b.subscribe("t", STRING)
        with pytest.raises(TimeoutError):
            await wrong.wait_for_publishers(timeout=0.3)
        assert "md5 sum" in caplog.text
        assert publisher.connections == 0
        with pytest.raises(TypeMismatchError):
            publisher.publish(TypeRegistry().message("std_msgs/Bool").new(data=True))


@pytest.mark.parametrize("near", [True, False])
async def test_concrete_type_after_any_ends_other_publishers(
    make_node: MakeNode, caplog: pytest.LogCaptureFixture, near: bool
) -> None:
    """A subscriber of any type takes all publishers; one of a type must not get the others' messages."""
    async with make_node("a", intra_process=near) as a, make_node("b", intra_process=near) as b:
        publisher = await a.advertise("t", STRING, latch=True)
        publisher.publish(data="text")
        raw: asyncio.Queue[bytes] = asyncio.Queue()
        relayed = await b.subscribe_serialized("t", "*", lambda payload, latched: raw.put_nowait(payload))
        assert await asyncio.wait_for(raw.get(), 20) == b"\x04\0\0\0text"
        numbers: list[object] = []
        other = await b.subscribe("t", "std_msgs/UInt64", numbers.append)
        assert (relayed.connections, other.connections) == (0, 0)
        async with asyncio.timeout(20):
            while publisher.connections:
                publisher.publish(data="four")  # as many bytes as a UInt64 has
                await asyncio.sleep(0)
            while "md5 sum" not in caplog.text:
                await asyncio.sleep(0.01)
        assert numbers == []
        right = await b.advertise("t", "std_msgs/UInt64")
        await right.wait_for_subscribers(timeout=20)
        right.publish(data=7)
        async with asyncio.timeout(20):
            while not numbers:
                await asyncio.sleep(0.01)
        assert [getattr(number, "data", None) for number in numbers] == [7]


async def test_handles_share_a_topic_until_the_last_is_closed(core: Core, make_node: MakeNode) -> None:
    async with make_node("a") as a, make_node("b") as b:
        first, second = await a.advertise("t", STRING), await a.advertise("t", STRING)
        one, two = await b.subscribe("t", STRING), await b.subscribe("t", STRING)
        await second.wait_for_subscribers(timeout=10)
        await first.close()
        await one.close()
        second.publish(data="still here")
        assert await collect(two, 1) == ["still here"]
        with pytest.raises(NodeClosedError):
            first.publish(data="no")
        assert [message async for message in one] == []
        await second.close()
        await two.close()
        assert "/t" not in core.graph.topic_types


async def test_leaving_unregisters_everything(core: Core, make_node: MakeNode) -> None:
    async with make_node("a") as a:
        await a.advertise("t", STRING)
        await a.subscribe("u", STRING)
        await a.advertise_service("s", "std_srvs/Empty", lambda request: None)
        assert ["/s", ["/a"]] in core.graph.system_state()[2]
    assert core.graph.system_state() == [[], [], []]
    with pytest.raises(NodeClosedError):
        await a.advertise("t", STRING)


async def test_log_records_are_published(make_node: MakeNode) -> None:
    async with make_node("a") as a, make_node("b") as b:
        a.log.warning("early %d", 1)
        heard = await b.subscribe("/rosout", "rosgraph_msgs/Log")
        found = []
        async with asyncio.timeout(60):
            async for record in heard:
                found.append((record.name, record.level, record.msg))
                if len(found) == 2:
                    break
                a.log.error("late")
        assert found == [("/a", 4, "early 1"), ("/a", 8, "late")]


async def test_a_node_without_master_says_so() -> None:
    with pytest.raises(MasterUnreachableError, match=r"127\.0\.0\.1:1/"):
        async with Node("a", argv=[], master_uri="http://127.0.0.1:1/", master_timeout=0):
            pass


async def test_an_error_of_the_program_comes_out_unchanged(make_node: MakeNode) -> None:
    with pytest.raises(ZeroDivisionError):
        async with make_node("a"):
            _ = 1 / 0


async def test_statistics_count_what_flowed(make_node: MakeNode) -> None:
    async with make_node("a") as a, make_node("b") as b:
        subscriber = await b.subscribe("t", STRING)
        publisher = await a.advertise("t", STRING)
        await publisher.wait_for_subscribers(timeout=10)
        publisher.publish(data="four")
        await collect(subscriber, 1)
        rpc = b._running.rpc
        _, _, (published, _, _) = await rpc.call(a.uri, "getBusStats", ("/x",))
        assert [entry[:2] for entry in published if entry[0] == "/t"] == [["/t", 8]]
        _, _, info = await rpc.call(b.uri, "getBusInfo", ("/x",))
        assert [entry[1:5] for entry in info] == [[a.uri, "i", "TCPROS", "/t"]]
        assert await rpc.call(a.uri, "getPublications", ("/x",)) == [
            1,
            "publications",
            [["/rosout", "rosgraph_msgs/Log"], ["/t", STRING]],
        ]
        assert await rpc.call(b.uri, "getSubscriptions", ("/x",)) == [1, "subscriptions", [["/t", STRING]]]


async def test_callbacks_may_publish_until_they_end(
    make_node: MakeNode, caplog: pytest.LogCaptureFixture
) -> None:
    """A node that leaves is not called any more when its publishers are closed."""
    async with make_node("flood") as flood:
        source = await flood.advertise("in", STRING)
        async with make_node("pass") as passing:
            output = await passing.advertise("out", STRING)
            seen = asyncio.Event()

            def pass_on(message: Message) -> None:
                output.publish(message)
                seen.set()

            await passing.subscribe("in", STRING, pass_on)
            sending = asyncio.create_task(_keep_publishing(source))
            await asyncio.wait_for(seen.wait(), 20)
        sending.cancel()
    assert [record.getMessage() for record in caplog.records if record.levelname == "ERROR"] == []


async def _keep_publishing(publisher: Publisher) -> None:
    while True:
        publisher.publish(data="x")
        await asyncio.sleep(0)


async def test_text_that_is_not_utf8_arrives(make_node: MakeNode) -> None:
    """Read with replacements, and untouched where it is passed on."""
    payload = b"\x04\0\0\0caf\xe9"
    async with make_node("a") as a, make_node("b") as b, asyncio.timeout(60):
        forwarded: asyncio.Queue[bytes] = asyncio.Queue()
        await b.subscribe_serialized("t", STRING, lambda data, _latched: forwarded.put_nowait(data))
        heard = await b.subscribe("t", STRING)
        publisher = await a.advertise("t", STRING)
        await publisher.wait_for_subscribers()
        publisher.publish_serialized(payload)
        assert await collect(heard, 1) == ["caf\ufffd"]
        assert await forwarded.get() == payload
