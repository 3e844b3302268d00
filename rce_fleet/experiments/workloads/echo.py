"""Publishes each message of a topic again on another one: ``echo TOPIC BACK``, both ``std_msgs/String``."""

from __future__ import annotations

import argparse

from .graph import open_graph

KIND = "std_msgs/String"
POLL_S = 0.1


def main() -> None:
    """Run the program until it is told to stop."""
    parser = argparse.ArgumentParser(prog="echo", description=__doc__)
    parser.add_argument("topic")
    parser.add_argument("back")
    options = parser.parse_args()
    graph = open_graph("echo")
    output = graph.output(options.back, KIND)
    graph.take(options.topic, KIND, lambda message: output.send({"data": message.data}))
    graph.run(lambda: POLL_S)


if __name__ == "__main__":
    main()
