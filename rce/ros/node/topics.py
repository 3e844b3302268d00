"""All topics of a node, published and subscribed, and the statistics of their connections."""

from __future__ import annotations

from functools import partial
from itertools import chain, islice
from typing import TYPE_CHECKING

from rce.ros.errors import HandshakeRefusedError, TypeMismatchError
from rce.ros.node.publisher import Publisher, TopicOutput
from rce.ros.node.runtime import Runtime, TypeName
from rce.ros.node.subscriber import Sink, Subscriber
from rce.ros.node.topic_input import TopicInput
from rce.ros.tcpros.connection import Connection
from rce.ros.tcpros.header import ANY

if TYPE_CHECKING:
    from rce.ros.types import MessageType


class Topics:
    """Topics by their global names.

    Several handles of a program may publish or subscribe to one topic: the first registers it at the master,
    the last takes that back. All wait for the registration; a handle whose wait fails or is cancelled leaves
    the others alone.
    """

    def __init__(self) -> None:
        self.outputs: dict[str, TopicOutput] = {}
        self.inputs: dict[str, TopicInput] = {}

    async def advertise(
        self, runtime: Runtime, topic: str, message_type: str | MessageType, *, latch: bool, queue_size: int
    ) -> Publisher:
        """Make a publisher; return once the master knows of the topic.

        Raises:
            TypeMismatchError: The node publishes the topic with another type already.
            MasterError: The registration at the master failed.
        """
        name = message_type if isinstance(message_type, str) else message_type.name
        output = self.outputs.get(topic)
        if output is None:
            output = TopicOutput(runtime, topic, message_type, queue_size)
            output.registration = runtime.registrations.begin(
                f"publisher of {topic}",
                register=partial(runtime.master.register_publisher, topic, name),
                unregister=partial(runtime.master.unregister_publisher, topic),
                is_needed=lambda: topic in self.outputs,
            )
            self.outputs[topic] = output
        elif output.message_type_name != name:
            raise TypeMismatchError(f"{topic} is published as {output.message_type_name} already, not {name}")
        output.queue_size = max(output.queue_size, queue_size)

        async def release(publisher: Publisher) -> None:
            if self._remove_publisher(output, publisher):
                await output.registration.release()

        publisher = Publisher(output, latch=latch, release=release)
        output.publishers.append(publisher)
        try:
            await output.registration.wait()
        except BaseException:
            if self._remove_publisher(output, publisher):
                output.registration.abandon()
            raise
        return publisher

    async def subscribe(
        self,
        runtime: Runtime,
        topic: str,
        message_type: MessageType | TypeName | None,
        sink: Sink,
        *,
        decodes: bool,
        hears_own: bool = True,
    ) -> Subscriber:
        """Make a subscriber; return once the master knows of it. Publishers are connected to after that.

        Args:
            runtime: The node's shared state.
            topic: The topic.
            message_type: Its type; ``None`` for any. Its name and checksum will do if nothing is decoded.
            sink: Takes the messages.
            decodes: Whether the sink decodes messages: it takes objects of publishers of this process too.
            hears_own: Whether it takes the messages of this node.

        Raises:
            TypeMismatchError: The node subscribes to the topic with another type already.
            MasterError: The registration at the master failed.
        """
        name, md5sum = (message_type.name, message_type.md5sum) if message_type is not None else (ANY, ANY)
        source = self.inputs.get(topic)
        if source is None:
            source = TopicInput(runtime, topic, name, md5sum)
            source.registration = runtime.registrations.begin(
                f"subscriber of {topic}",
                register=source.register,
                unregister=partial(runtime.master.unregister_subscriber, topic),
                is_needed=lambda: topic in self.inputs,
            )
            self.inputs[topic] = source
        source.check(name, md5sum)

        async def release(subscriber: Subscriber) -> None:
            if self._remove_subscriber(source, subscriber):
                await source.registration.release()

        subscriber = Subscriber(
            topic,
            message_type,
            sink,
            release,
            source.connected,
            source.changed,
            runtime.check_running,
            decodes=decodes,
            hears_own=hears_own,
        )
        source.subscribers = [*source.subscribers, subscriber]  # a new list: one may be in use by a delivery
        source.catch_up(subscriber)
        try:
            await source.registration.wait()
        except BaseException:
            if self._remove_subscriber(source, subscriber):
                source.registration.abandon()
            subscriber.sink.end()
            raise
        return subscriber

    def disconnect(self) -> None:
        """Disconnect all subscribers as the node leaves; links within the process end in no other way."""
        for output in self.outputs.values():
            output.close()

    def _remove_publisher(self, output: TopicOutput, publisher: Publisher) -> bool:
        """Remove a handle; return whether it was the last one, with which the topic is removed."""
        if publisher not in output.publishers:  # closed while it waited for the master
            return False
        output.publishers.remove(publisher)
        if output.publishers:
            return False
        del self.outputs[output.topic]
        output.close()
        return True

    def _remove_subscriber(self, source: TopicInput, subscriber: Subscriber) -> bool:
        """Remove a handle; return whether it was the last one, with which the topic is removed."""
        if subscriber not in source.subscribers:  # closed while it waited for the master
            return False
        source.subscribers = [one for one in source.subscribers if one is not subscriber]
        if source.subscribers:
            return False
        del self.inputs[source.topic]
        source.close()
        return True

    def accept(self, connection: Connection, fields: dict[str, str]) -> None:
        """Take a subscriber's connection.

        Raises:
            HandshakeRefusedError: The topic is not published here, or as another type.
        """
        output = self.outputs.get(fields["topic"])
        if output is None:
            raise HandshakeRefusedError(f"topic {fields['topic']} is not published here")
        output.accept(connection, fields)

    # For the slave API

    def names(self, count: int) -> list[str]:
        """Return the first ``count`` topics that are published or subscribed to."""
        return list(
            islice(dict.fromkeys(chain(islice(self.outputs, count), islice(self.inputs, count))), count)
        )

    def bus_info(self) -> list[list[object]]:
        """Return ``[id, destination, direction, protocol, topic, connected, text]`` of each connection."""
        info: list[list[object]] = []
        for topic, output in self.outputs.items():
            info += [
                [_id(link), link.subscriber, "o", link.transport, topic, True, link.description]
                for link in output.all_links
            ]
        for topic, source in self.inputs.items():
            info += [
                [_id(link), link.uri, "i", link.transport, topic, True, link.publisher]
                for link in source.links
            ]
        return info

    def publish_stats(self) -> list[list[object]]:
        """Return ``[topic, bytes, [[id, bytes, messages, connected], ...]]`` of each published topic."""
        return [
            [
                topic,
                sum(link.bytes_out for link in output.all_links),
                [[_id(link), link.bytes_out, link.messages, True] for link in output.all_links],
            ]
            for topic, output in self.outputs.items()
        ]

    def subscribe_stats(self) -> list[list[object]]:
        """Return ``[topic, [[id, bytes, messages, dropped, connected], ...]]`` of each subscribed topic."""
        return [
            [topic, [[_id(link), link.bytes_in, link.messages, -1, True] for link in source.links]]
            for topic, source in self.inputs.items()
        ]


def _id(link: object) -> int:
    """A number for a connection, as XML-RPC can carry it."""
    return id(link) >> 4 & 0x7FFFFFFF
