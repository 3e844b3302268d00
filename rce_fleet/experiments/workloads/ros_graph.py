"""The ROS graph by rospy."""

from __future__ import annotations

import sys
import threading
import time
from typing import TYPE_CHECKING, Any

import roslib.message
import rospy

from .graph import QUEUE

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from .graph import Stamp


class RosGraph:
    """A node of rospy.

    Args:
        name: The node's.
    """

    def __init__(self, name: str) -> None:
        rospy.init_node(name, anonymous=True)
        self._is_running = False

    def output(self, topic: str, kind: str) -> RosOutput:
        """Publish a topic of a type."""
        output = RosOutput(roslib.message.get_message_class(kind))
        self._make(lambda: output.open(topic))
        return output

    def take(self, topic: str, kind: str, callback: Callable[[Any], None]) -> None:
        """Call back with each message of a topic, in a thread of the connection."""
        message_class = roslib.message.get_message_class(kind)
        self._make(lambda: rospy.Subscriber(topic, message_class, callback, queue_size=QUEUE))

    def provide(self, service: str, kind: str, answer: Callable[[], Mapping[str, Any]]) -> None:
        """Answer the calls of a service, in a thread of the connection."""
        service_class = roslib.message.get_service_class(kind)
        self._make(lambda: rospy.Service(service, service_class, lambda _request: dict(answer())))

    def call(self, service: str, kind: str, callback: Callable[[Any], None]) -> None:
        """Call a service; call back with its answer, if there is one, in a thread of the call."""
        service_class = roslib.message.get_service_class(kind)
        self._make(lambda: callback(rospy.ServiceProxy(service, service_class)()))

    def run(self, step: Callable[[], float]) -> None:
        """Call ``step`` until the program is told to stop; it returns the seconds until its next call."""
        self._is_running = True
        while not rospy.is_shutdown():
            time.sleep(step())

    def _make(self, work: Callable[[], object]) -> None:
        if self._is_running:
            threading.Thread(target=_beside, args=(work,), daemon=True).start()
        else:
            work()


def _beside(work: Callable[[], object]) -> None:
    try:
        work()
    except (rospy.ServiceException, rospy.ROSException, OSError) as error:
        print(error, file=sys.stderr)  # noqa: T201


class RosOutput:
    """A topic that the program publishes.

    Args:
        message_class: Class of its messages.
    """

    def __init__(self, message_class: Any) -> None:
        self._message_class = message_class
        self._publisher: Any = None

    def open(self, topic: str) -> None:
        """Make the publisher."""
        self._publisher = rospy.Publisher(topic, self._message_class, queue_size=QUEUE)

    def send(self, fields: Mapping[str, Any], stamp: Stamp | None = None) -> None:
        """Publish a message with these fields, and with a header; without effect before it is made."""
        if self._publisher is None:
            return
        message = self._message_class()
        if stamp is not None:
            message.header.stamp = rospy.Time(*divmod(stamp.ns, 1_000_000_000))
            message.header.frame_id = stamp.frame
        for name, value in fields.items():
            setattr(message, name, value)
        self._publisher.publish(message)
