"""The examples in the docstrings of a connection and its interfaces are run as they are written."""

from __future__ import annotations

import asyncio
import inspect
import struct
import textwrap
from typing import TYPE_CHECKING, Any

import pytest

from rce_client import Connection, Publisher, ServiceClient, ServiceProvider, Subscriber

if TYPE_CHECKING:
    from integration.client.conftest import Engine

CLASSES = (Connection, Publisher, Subscriber, ServiceClient, ServiceProvider)
INSIDE = {  # what an interface takes from its connection, not from the program
    "call_of",
    "deliver",
    "fits",
    "on_active",
    "on_closed",
    "on_fault",
    "on_inactive",
    "on_lost",
}
WITHOUT_END = {"Connection.wait_refused"}


def _public() -> dict[str, Any]:
    """Return the methods of the classes that a program calls, by their names."""
    found: dict[str, Any] = {}
    for owner in CLASSES:
        for name, method in inspect.getmembers(owner, inspect.isfunction):
            told = name in INSIDE or (name == "keep_latched" and owner is not Publisher)
            if not name.startswith("_") and not told:
                found[f"{owner.__name__}.{name}"] = method
    return found


METHODS = _public()


def _example(doc: str | None) -> str:
    _, _, rest = inspect.cleandoc(doc or "").partition("Example:\n")
    return textwrap.dedent(rest).partition("```python\n")[2].partition("```")[0]


@pytest.mark.parametrize("name", METHODS)
def test_public_methods_say_what_they_do(name: str) -> None:
    """Each has an example; a coroutine's docstring says what cancellation does, and what it raises."""
    doc = inspect.getdoc(METHODS[name]) or ""
    assert _example(doc)
    if inspect.iscoroutinefunction(METHODS[name]):
        assert "cancel" in doc.lower()
        assert "Raises:\n" in doc


@pytest.mark.parametrize(
    "name", [*METHODS, *(owner.__name__ for owner in (Subscriber, ServiceClient))], ids=str
)
async def test_an_example_runs(name: str, engine: Engine) -> None:
    source = _example(inspect.getdoc(METHODS[name] if name in METHODS else globals()[name]))
    assert source
    scope: dict[str, Any] = {}
    exec(f"async def example(robot):\n{textwrap.indent(source, '    ')}", scope)
    async with asyncio.timeout(60), engine.connection() as robot:
        speaker = asyncio.create_task(_speak(engine))
        try:
            if name in WITHOUT_END:
                with pytest.raises(TimeoutError):
                    async with asyncio.timeout(0.2):
                        await scope["example"](robot)
            else:
                await scope["example"](robot)
        finally:
            speaker.cancel()
        assert not robot.errors


async def _speak(engine: Engine) -> None:
    """Publish something on every topic that a robot listens to, as soon as it listens."""
    payload = struct.pack("<I", 2) + b"hi"
    spoken: set[str] = set()
    while True:
        for tag, end in list(engine.cloud.ends.items()):
            if tag not in spoken and "Subscriber" in end.port.spec.type:
                await end.until_active()
                end.port.send(payload)
                spoken.add(tag)
        await asyncio.sleep(0.01)
