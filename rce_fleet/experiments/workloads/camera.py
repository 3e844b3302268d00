"""A camera: ``camera --control FILE --images FILE`` publishes ready-made images.

The file of images has one JSON object per line: ``stream``, ``topic``, ``type``, ``fields``, and ``file``
with the bytes of the field ``data``. Images are compressed beforehand, as by a camera that does it itself.
"""

from __future__ import annotations

import argparse
import json
from itertools import cycle
from pathlib import Path
from typing import Any

from .graph import open_graph
from .source import Source, Stream

LAST = {"sensor_msgs/Image": {"height": 1, "width": 1, "encoding": "rgb8", "step": 3, "data": bytes(3)}}
"""The last message of a type, where an empty one is not legal."""


def streams_of(path: Path) -> list[Stream]:
    """Read the streams of a file of images."""
    found: dict[tuple[str, str, str], list[dict[str, Any]]] = {}
    for line in path.read_text().splitlines():
        image = json.loads(line)
        key = (image["stream"], image["topic"], image["type"])
        fields = {**image["fields"], "data": (path.parent / image["file"]).read_bytes()}
        found.setdefault(key, []).append(fields)
    return [Stream(*key, cycle(images), LAST.get(key[2], {})) for key, images in found.items()]


def main() -> None:
    """Run the program until it is told to stop."""
    parser = argparse.ArgumentParser(prog="camera", description=__doc__)
    parser.add_argument("--control", type=Path, required=True)
    parser.add_argument("--images", type=Path, required=True)
    options = parser.parse_args()
    graph = open_graph("camera")
    graph.run(Source(graph, streams_of(options.images), options.control).step)


if __name__ == "__main__":
    main()
