"""What hostile nodes found out and got, as root's guests and as a normal user's."""

from __future__ import annotations

from typing import Any

import pytest
from support.hostile_world import MODULE
from support.persons import Person


@pytest.fixture(
    scope="session", params=["root", "normal", pytest.param("podman", marks=pytest.mark.needs("podman"))]
)
def person(request: pytest.FixtureRequest) -> Person:
    found = request.getfixturevalue(f"{request.param}_person")
    assert isinstance(found, Person)
    return found


@pytest.fixture(scope="session")
def attacked(person: Person) -> dict[str, Any]:
    """How attempts to leave and to spy ended."""
    return person.run("attack", module=MODULE)
