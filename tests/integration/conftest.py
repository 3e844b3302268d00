"""People who run the engine; made once for all tests that need them."""

from __future__ import annotations

from collections.abc import Iterator
from copy import copy

import pytest
from support import persons
from support.persons import Person


@pytest.fixture(scope="session")
def root_person() -> Iterator[Person]:
    with persons.root() as person:
        yield person


@pytest.fixture(scope="session")
def normal_person() -> Iterator[Person]:
    with persons.normal() as person:
        yield person


@pytest.fixture(scope="session")
def podman_person(root_person: Person) -> Person:
    """Root with podman, which has the machine's programs where no image is named."""
    person = copy(root_person)
    person.runtime = "podman"
    return person
