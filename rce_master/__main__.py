"""Starts ``rce-master``; handed-over settings do not load the command-line parser, which takes 5 MB."""

from __future__ import annotations

import sys

from rce.config import handed_over


def main() -> None:
    """Run the program."""
    settings = handed_over(sys.argv[1:])
    if settings is None:
        from rce_master.command import app

        app(prog_name="rce-master")
    else:
        from rce_master.program import run

        sys.exit(run(settings))


if __name__ == "__main__":
    main()
