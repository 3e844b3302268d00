"""The core's ``/rosout`` node: gathers the log records of all nodes on one topic, as every ROS core does.

A tool that shows logs then holds one connection, to ``/rosout_agg``, instead of one to each node. Records are
passed on as they are on the wire: neither the type's text nor its codec is loaded until somebody listens.
"""

from __future__ import annotations

from rce.ros.node.member import DEFAULT_QUEUE
from rce.ros.node.node import Node
from rce.ros.node.rosout import KIND, MD5SUM, TOPIC
from rce.ros.node.runtime import TypeName

NAME = "rosout"
AGGREGATE = "/rosout_agg"


class RosoutNode(Node):
    """The node ``/rosout``. An async context manager."""

    def __init__(self, master_uri: str, host: str) -> None:
        """Prepare the node.

        Args:
            master_uri: The core.
            host: Under which others reach the node.
        """
        super().__init__(
            NAME,
            namespace="/",
            argv=[f"__hostname:={host}"],
            master_uri=master_uri,
            signals=False,
            rosout=False,
        )

    async def gather(self) -> None:
        """Begin to pass records on."""
        aggregate = await self._topics.advertise(
            self._running, AGGREGATE, KIND, latch=False, queue_size=DEFAULT_QUEUE
        )
        await self.subscribe_serialized(
            TOPIC, TypeName(KIND, MD5SUM), lambda payload, _: aggregate.publish_serialized(payload)
        )
