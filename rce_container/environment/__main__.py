"""``python -m rce_container.environment BOOT``: the first process of a container without a fork server."""

from __future__ import annotations

import os
import socket
import sys

from rce_container.environment.messages import decode_boot
from rce_container.environment.process import OF_ENVIRONMENT, become_subreaper, set_oom_score
from rce_container.environment.running import run_environment


def main() -> None:
    """Run the environment that the first argument describes. It is not isolated."""
    boot = decode_boot(sys.argv[1])
    control, links = (socket.socket(fileno=os.dup(fd)) for fd in (0, 1))
    with open(os.devnull, "rb") as nothing:  # noqa: PTH123
        os.dup2(nothing.fileno(), 0)
    set_oom_score(OF_ENVIRONMENT)
    become_subreaper()
    run_environment(boot, control, links)


main()
