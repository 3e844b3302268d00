"""Starts ``rce-container``; handed-over settings do not load the command-line parser, which takes 5 MB."""

from __future__ import annotations

import sys

from rce.config import handed_over


def main() -> None:
    """Run the program."""
    settings = handed_over(sys.argv[1:], master=True)
    if settings is None:
        from rce_container.command import app

        app(prog_name="rce-container")
    else:
        from rce_container.program import run

        sys.exit(run(settings))


if __name__ == "__main__":
    main()
