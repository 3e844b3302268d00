"""Broadcasters, which publish transforms to the graph."""

from __future__ import annotations

from contextlib import AsyncExitStack
from types import TracebackType
from typing import TYPE_CHECKING, Self

from rce.ros.closing import release
from rce.ros.tf.frames import PARAMETER, resolve
from rce.ros.tf.stamped import StampedTransform
from rce.ros.tf.transform import Transform

if TYPE_CHECKING:
    from rce.ros.node import Node, Publisher
    from rce.ros.types import Time

TF = "/tf"
TF_STATIC = "/tf_static"
KIND = "tf2_msgs/TFMessage"


async def find_prefix(node: Node) -> str:
    """Return the prefix of the frames of a node's robot: the parameter ``tf_prefix``; empty without it."""
    parameter = await node.search_param(PARAMETER)
    return "" if parameter is None else str(await node.get_param(parameter, ""))


class TransformBroadcaster:
    """Publishes on ``/tf``. An async context manager.

    ``async with TransformBroadcaster(node) as tf: tf.send("odom", "base_link", Transform.make(x=1.0))``

    Attributes:
        prefix: The prefix of frames whose names do not begin with a slash.
    """

    _topic, _latch = TF, False

    def __init__(self, node: Node, *, prefix: str | None = None) -> None:
        """Prepare a broadcaster.

        Args:
            node: The node that it is part of; it must be running while the broadcaster is.
            prefix: The prefix of the frames; None: the parameter ``tf_prefix``.
        """
        self.prefix = prefix or ""
        self._search = prefix is None
        self._node = node
        self._stack = AsyncExitStack()
        self._publisher: Publisher

    async def __aenter__(self) -> Self:
        if self._search:
            self.prefix = await find_prefix(self._node)
        self._publisher = await self._node.advertise(self._topic, KIND, latch=self._latch)
        self._stack.push_async_callback(release, self._publisher)
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self._stack.aclose()

    def send(self, parent: str, child: str, transform: Transform, stamp: Time | None = None) -> None:
        """Send the transform of a frame.

        Args:
            parent: The frame that ``transform`` takes coordinates to.
            child: The frame that it takes them from.
            transform: ``parent_from_child``.
            stamp: When; None: now.

        Raises:
            BadTransformError: It cannot be an edge of a tree.
        """
        moment = self._node.now() if stamp is None else stamp
        self.send_stamped(StampedTransform(parent, child, transform, moment))

    def send_stamped(self, *transforms: StampedTransform) -> None:
        """Send the transforms of frames in one message.

        Raises:
            BadTransformError: One of them cannot be an edge of a tree; nothing was sent.
        """
        self._publish([self._resolved(stamped) for stamped in transforms])

    def _publish(self, transforms: list[StampedTransform]) -> None:
        self._publisher.publish(transforms=[stamped.fields for stamped in transforms])

    def _resolved(self, stamped: StampedTransform) -> StampedTransform:
        resolved = StampedTransform(
            resolve(self.prefix, stamped.parent) if stamped.parent else "",
            resolve(self.prefix, stamped.child) if stamped.child else "",
            stamped.transform,
            stamped.stamp,
        )
        resolved.check()
        return resolved


class StaticTransformBroadcaster(TransformBroadcaster):
    """Publishes transforms that never change on ``/tf_static``; later subscribers get all of them.

    A new transform of a frame replaces its earlier one.
    """

    _topic, _latch = TF_STATIC, True

    def __init__(self, node: Node, *, prefix: str | None = None) -> None:
        """Prepare a broadcaster; as for :class:`TransformBroadcaster`."""
        super().__init__(node, prefix=prefix)
        self._sent: dict[str, StampedTransform] = {}

    def _publish(self, transforms: list[StampedTransform]) -> None:
        self._sent |= {stamped.child: stamped for stamped in transforms}
        super()._publish(list(self._sent.values()))
