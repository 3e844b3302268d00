"""References in docstrings become links to what the reference pages show."""

from __future__ import annotations

from typing import TYPE_CHECKING

import griffe
import pytest

from tools import docs_roles

if TYPE_CHECKING:
    from pathlib import Path

SOURCE = '''
"""The module.

::

    a tree
"""


class Base:
    """A base."""

    def stop(self):
        """Stop; see :meth:`run`."""


class Engine(Base):
    """Runs after :meth:`run` until :meth:`stop`, told by :class:`~things.Hidden`.

    Like this::

        engine.run()
    """

    def run(self):
        """Run until :meth:`stop`; see :func:`asyncio.run` and :class:`Engine`."""


class Hidden:
    """Not on a page."""
'''


@pytest.fixture
def things(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> griffe.Module:
    (tmp_path / "things.py").write_text(SOURCE)
    (tmp_path / "page.md").write_text("# Engine\n\n::: things.Engine\n    options: {}\n")
    monkeypatch.setattr(docs_roles, "PAGES", tmp_path)
    extensions = griffe.load_extensions(docs_roles.Roles())
    module = griffe.load("things", search_paths=[tmp_path], extensions=extensions)
    assert isinstance(module, griffe.Module)
    return module


def said(item: griffe.Object | griffe.Alias) -> str:
    assert item.docstring is not None
    return item.docstring.value


def test_what_a_page_shows_is_linked(things: griffe.Module) -> None:
    assert said(things["Engine.run"]).startswith("Run until [`Engine.stop`][things.Engine.stop];")
    assert said(things["Engine.run"]).endswith("and [`Engine`][things.Engine].")
    assert "after [`Engine.run`][things.Engine.run] until" in said(things["Engine"])


def test_what_no_page_shows_is_a_name(things: griffe.Module) -> None:
    assert "told by `Hidden`." in said(things["Engine"])
    assert "see `run` and" in said(things["Engine.run"])


def test_literal_blocks_lose_their_colons(things: griffe.Module) -> None:
    assert "Like this:\n\n    engine.run()" in said(things["Engine"])
    assert said(things).split("\n") == ["The module.", "", "", "", "    a tree"]
