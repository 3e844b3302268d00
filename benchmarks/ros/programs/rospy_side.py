"""The rospy side of the measurements; the words of ``ours.py``. Runs with the machine's Python.

``QUEUE=0`` in the environment publishes in the caller's thread, which is rospy's fastest way.
"""

from __future__ import annotations

import json
import os
import sys
import threading
import time
from typing import Any

import rospy
from std_msgs.msg import Float64, String
from std_srvs.srv import SetBool, SetBoolResponse

BUFFER = 2**25
QUEUE = None if os.environ.get("QUEUE") == "0" else 10
IN_FLIGHT = 32


def ready() -> None:
    """Print the name of the measured library."""
    print("ready", flush=True)


def connected(publisher: Any, count: int = 1) -> None:
    """Wait for subscribers."""
    while publisher.get_num_connections() < count:
        time.sleep(0.05)


def echo() -> None:
    """Send every message back."""
    pong = rospy.Publisher("pong", String, queue_size=QUEUE, tcp_nodelay=True)
    rospy.Subscriber("ping", String, pong.publish, buff_size=BUFFER, tcp_nodelay=True)
    ready()
    rospy.spin()


def ping(sizes: str) -> None:
    """Send each size repeatedly, one message in flight."""
    answered = threading.Event()
    rospy.Subscriber("pong", String, lambda _: answered.set(), buff_size=BUFFER, tcp_nodelay=True)
    publisher = rospy.Publisher("ping", String, queue_size=QUEUE, tcp_nodelay=True)
    connected(publisher)
    time.sleep(1)
    found = {}
    for size, count in json.loads(sizes):
        text, times = "x" * size, []
        for _ in range(count + 3):
            answered.clear()
            begin = time.perf_counter()
            publisher.publish(String(text))
            answered.wait()
            times.append(time.perf_counter() - begin)
        found[str(size)] = times[3:]
    print(json.dumps(found), flush=True)


def talk(seconds: str) -> None:
    """Publish as fast as possible."""
    publisher = rospy.Publisher("flood", String, queue_size=None if QUEUE is None else 1000)
    connected(publisher)
    text, sent, end = "x" * 60, 0, time.perf_counter() + float(seconds)
    while time.perf_counter() < end:
        for _ in range(100):
            publisher.publish(String(text))
        sent += 100
    print(json.dumps({"sent": sent}), flush=True)
    rospy.spin()


def listen() -> None:
    """Count messages."""
    state = {"first": 0.0, "last": 0.0, "count": 0}

    def heard(_: Any) -> None:
        state["last"] = time.perf_counter()
        state["first"] = state["first"] or state["last"]
        state["count"] += 1

    rospy.Subscriber("flood", String, heard, queue_size=1000, buff_size=BUFFER)
    ready()
    rospy.spin()
    print(json.dumps({"received": state["count"], "seconds": state["last"] - state["first"]}), flush=True)


def serve() -> None:
    """Answer calls."""
    rospy.Service("flip", SetBool, lambda request: SetBoolResponse(not request.data, ""))
    ready()
    rospy.spin()


def call(seconds: str) -> None:
    """Call one after the other; then in threads, each with a connection."""
    rospy.wait_for_service("flip", 20)
    found = {}
    for kind in (True, False):
        client = rospy.ServiceProxy("flip", SetBool, persistent=kind)
        count, begin = 0, time.perf_counter()
        while time.perf_counter() < begin + float(seconds):
            client(True)
            count += 1
        found["persistent" if kind else "single"] = count / (time.perf_counter() - begin)
    found[f"{IN_FLIGHT} in flight"] = rate_in_flight(float(seconds))
    print(json.dumps(found), flush=True)


def rate_in_flight(seconds: float) -> float:
    """Call in threads; return calls per second."""
    counts = [0] * IN_FLIGHT
    begin = time.perf_counter()

    def call_again_and_again(number: int) -> None:
        client = rospy.ServiceProxy("flip", SetBool, persistent=True)
        while time.perf_counter() < begin + seconds:
            client(True)
            counts[number] += 1

    threads = [threading.Thread(target=call_again_and_again, args=(number,)) for number in range(IN_FLIGHT)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return sum(counts) / (time.perf_counter() - begin)


def beat(count: str) -> None:
    """Publish the time of sending at 20 Hz."""
    publisher = rospy.Publisher("beat", Float64, queue_size=QUEUE, tcp_nodelay=True)
    connected(publisher, int(count))
    ready()
    while not rospy.is_shutdown():
        time.sleep(0.05)
        publisher.publish(Float64(time.monotonic()))


def idle() -> None:
    """Do nothing, on a topic in either direction."""
    rospy.Publisher("idle_out", String, queue_size=10)
    rospy.Subscriber("idle_in", String, lambda _: None)
    ready()
    rospy.spin()


if __name__ == "__main__":
    rospy.init_node(f"rospy_{sys.argv[1]}")
    globals()[sys.argv[1]](*sys.argv[2:])
