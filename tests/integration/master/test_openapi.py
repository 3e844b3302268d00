"""The OpenAPI document is true: requests made of it, good and bad, are answered as it says."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import pytest
from support.fuzzing import Tracebacks, answers_of

if TYPE_CHECKING:
    from integration.master.conftest import Site

PREFIX = "/api/v1"
STREAMS = ("/events", "/usage/live")


# The library uses random numbers of its own within its strategies.
@pytest.mark.filterwarnings("ignore::hypothesis.errors.HypothesisDeprecationWarning")
async def test_answers_are_those_of_the_document(site: Site) -> None:
    document = await site.api("GET", "/openapi.json", token="")
    for path in STREAMS:  # they have no end
        del document["paths"][PREFIX + path]
    del document["paths"][f"{PREFIX}/login"]["delete"]  # it would end the token
    # Bodies that are files cannot be made of a schema.
    del document["paths"][PREFIX + "/packages/{name}/{version}"]["put"]
    async with site.containers(), site.robots():
        with Tracebacks().watching() as log:
            answered = await asyncio.to_thread(answers_of, document, site.url.rstrip("/"), site.token)
    assert answered > len(document["paths"])
    assert not log.found
