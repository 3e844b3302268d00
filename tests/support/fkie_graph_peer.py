"""fkie's programs as far as one ROS graph sees them, made of the facts of their messages alone.

Run by the Python of a real ROS: ``fkie_graph_peer.py listen`` prints what a discovery says in the graph, as
fkie's master_sync hears it: ``change STATE NAME`` and ``link NAME SECONDS_SINCE_ITS_HEARTBEAT``.
``fkie_graph_peer.py discover STATE NAME URI MONITOR_URI`` speaks as fkie's master_discovery: its list is
empty and asked for only once, and each subscriber of ``changes`` is told of one master.

The definitions are those of releases 1.1.0 to 1.3.2; ``quoted`` as a last argument takes the constants of
releases before.
"""
# ruff: noqa: T201

from __future__ import annotations

import hashlib
import sys
from collections.abc import Callable
from typing import Any

import genpy
import rospy
from genpy.dynamic import generate_dynamic

PACKAGE = "fkie_multimaster_msgs"
MASTER = """string name
string uri
time last_change
time last_change_local
bool online
string discoverer_name
string monitoruri
"""
STATE = "string state\nfkie_multimaster_msgs/ROSMaster master\n"
STATES = "".join(f"string STATE_{word.upper()}={{0}}{word}{{0}}\n" for word in ("new", "removed", "changed"))
LINK = "string destination\nfloat32 quality\ntime last_heartbeat\n"
LINKS = "Header header\nfkie_multimaster_msgs/LinkState[] links\n"
HEADER = "uint32 seq\ntime stamp\nstring frame_id\n"
NODE = "/master_discovery"


def message(name: str, text: str, **parts: str) -> Any:
    """Make a message class of a definition and those that it uses."""
    full = text + "".join(
        f"{'=' * 80}\nMSG: {part.replace('__', '/')}\n{body}" for part, body in parts.items()
    )
    return generate_dynamic(PACKAGE + "/" + name, full)[PACKAGE + "/" + name]


def master_state(quote: str) -> Any:
    """Make MasterState, its constants with quotes or without."""
    return message("MasterState", STATE + STATES.format(quote), fkie_multimaster_msgs__ROSMaster=MASTER)


def listen(changes: Any) -> None:
    """Print what the discovery says, as master_sync compares it."""
    words = {changes.STATE_NEW: "new", changes.STATE_CHANGED: "changed", changes.STATE_REMOVED: "removed"}
    links = message(
        "LinkStatesStamped", LINKS, std_msgs__Header=HEADER, fkie_multimaster_msgs__LinkState=LINK
    )
    print("md5", changes._md5sum, links._md5sum, flush=True)

    def changed(said: Any) -> None:
        print("change", words.get(said.state, "?" + said.state), said.master.name, flush=True)

    def linked(said: Any) -> None:
        for link in said.links:
            print("link", link.destination, (said.header.stamp - link.last_heartbeat).to_sec(), flush=True)

    rospy.init_node("master_sync")
    rospy.Subscriber(NODE + "/changes", changes, changed)
    rospy.Subscriber(NODE + "/linkstats", links, linked)
    rospy.spin()


def discover(changes: Any, state: str, name: str, uri: str, monitor_uri: str) -> None:
    """Tell every subscriber of one master."""
    known = message("ROSMaster", MASTER)

    class DiscoverMasters:
        """The service of list_masters."""

        _type = PACKAGE + "/DiscoverMasters"
        _md5sum = hashlib.md5(f"{known._md5sum} masters".encode()).hexdigest()
        _request_class = message("DiscoverMastersRequest", "")
        _response_class = message(
            "DiscoverMastersResponse",
            PACKAGE + "/ROSMaster[] masters\n",
            fkie_multimaster_msgs__ROSMaster=MASTER,
        )

    class Greeter(rospy.SubscribeListener):  # type: ignore[misc]  # rospy has no types
        """Tells who comes."""

        def peer_subscribe(self, _topic: str, _publish: object, peer_publish: Callable[[Any], None]) -> None:
            now = genpy.Time.from_sec(rospy.get_time())
            peer_publish(changes(state, known(name, uri, now, now, True, NODE, monitor_uri)))

    lists = [DiscoverMasters._response_class()]
    rospy.init_node(NODE[1:])
    rospy.Service(NODE + "/list_masters", DiscoverMasters, lambda _: lists.pop() if lists else None)
    rospy.Publisher(NODE + "/changes", changes, subscriber_listener=Greeter(), queue_size=10)
    print("ready", flush=True)
    rospy.spin()


if __name__ == "__main__":
    arguments = sys.argv[1:]
    definition = master_state("'" if arguments[-1] == "quoted" else "")
    if arguments[0] == "listen":
        listen(definition)
    else:
        discover(definition, *arguments[1:5])
