"""Logs in at an engine: ``engine_login.py URL USER FILE``, with the password on standard input.

The file gets the address and the token, as ``node_log.py`` reads them. It is done by the standard library
alone: an experiment logs in at each engine that it starts, and this starts in a tenth of the time of
``rce login``.
"""

from __future__ import annotations

import json
import sys
import urllib.request
from pathlib import Path


def token_of(url: str, user: str, password: str) -> str:
    """Return a token for a user.

    Raises:
        urllib.error.URLError: The engine cannot be reached, or refuses it.
    """
    account = {"userID": user, "password": password, "label": "rce experiment"}
    request = urllib.request.Request(  # noqa: S310 - the engine of this run
        f"{url}api/v1/login", json.dumps(account).encode(), {"Content-Type": "application/json"}
    )
    with urllib.request.urlopen(request) as answer:  # noqa: S310
        token: str = json.load(answer)["token"]
        return token


def main() -> int:
    """Run the program."""
    url, user, file = sys.argv[1:]
    token = token_of(url, user, sys.stdin.readline().rstrip("\n"))
    written = Path(file)
    written.touch(mode=0o600)
    written.write_text(json.dumps({"url": url, "token": token}))
    return 0


if __name__ == "__main__":
    sys.exit(main())
