"""Prints what is kept of the standard output of a node: ``node_log.py LOGIN CONTAINER NODE``.

As ``rce logs CONTAINER/NODE --stdout``, but by the standard library alone: it starts in a tenth of the time,
and an experiment with fifty containers reads hundreds of logs. It prints nothing while the container or the
engine's master is not there, as after a fault: who reads the log tries again.
"""

from __future__ import annotations

import json
import sys
import urllib.error
import urllib.parse
import urllib.request
from pathlib import Path
from typing import Any

CHUNK = 1_000_000
UNAVAILABLE = 503
"""The container is not there for now."""


def text_of(url: str, token: str, container: str, node: str) -> str:
    """Return the standard output of a node, as far as it is kept.

    Raises:
        urllib.error.URLError: The engine cannot be reached, or refuses it.
    """
    found, offset = [], 0
    while True:
        query = urllib.parse.urlencode({"stream": "stdout", "limit": CHUNK, "offset": offset})
        request = urllib.request.Request(  # noqa: S310 - the engine of this run
            f"{url}api/v1/containers/{container}/nodes/{node}/log?{query}",
            headers={"Authorization": f"Bearer {token}"},
        )
        with urllib.request.urlopen(request) as answer:  # noqa: S310
            chunk: dict[str, Any] = json.load(answer)
        found.append(chunk["text"])
        if chunk["offset"] == offset:
            return "".join(found)
        offset = chunk["offset"]


def main() -> int:
    """Run the program."""
    login, container, node = sys.argv[1:]
    account = json.loads(Path(login).read_text())
    try:
        text = text_of(account["url"], account["token"], container, node)
    except urllib.error.HTTPError as error:
        if error.code != UNAVAILABLE:
            raise
    except urllib.error.URLError as error:
        if not isinstance(error.reason, ConnectionError):
            raise
    except ConnectionError:
        pass  # the master was killed while it answered
    else:
        sys.stdout.write(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
