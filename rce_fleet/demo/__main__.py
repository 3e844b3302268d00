"""``python -m rce_fleet.demo``: the same as ``rce demo``."""

from __future__ import annotations

import typer

from rce_fleet.demo.command import demo


def main() -> None:
    """Run the program."""
    app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
    app.command(name="demo")(demo)
    app()


if __name__ == "__main__":
    main()
