"""The OpenAPI document is true: requests made of it, good and bad, are answered as it says."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

import pytest
import schemathesis
from hypothesis import HealthCheck, Phase, given, seed, settings
from schemathesis import GenerationMode, checks
from schemathesis.specs.openapi import checks as openapi_checks
from support.fuzzing import EXAMPLES, SEED, Tracebacks

if TYPE_CHECKING:
    from conftest import Site

PREFIX = "/api/v1"
COUNT = 4
"""Requests for each operation and mode."""
STREAMS = ("/events", "/usage/live")
CHECKS = [
    checks.not_a_server_error,
    openapi_checks.status_code_conformance,
    openapi_checks.content_type_conformance,
    openapi_checks.response_schema_conformance,
]


def ask(document: dict[str, Any], url: str, token: str) -> int:
    """Make requests of all operations; return how many were answered as the document says."""
    schema = schemathesis.openapi.from_dict(document)
    headers = {"Authorization": f"Bearer {token}"}
    answered = 0
    for result in schema.get_all_operations():
        operation = result.ok()
        for mode in (GenerationMode.POSITIVE, GenerationMode.NEGATIVE):

            @seed(SEED)
            @settings(
                max_examples=EXAMPLES // 100 or COUNT,
                deadline=None,
                database=None,
                phases=[Phase.generate],
                suppress_health_check=list(HealthCheck),
            )
            @given(case=operation.as_strategy(generation_mode=mode))
            def run(case: schemathesis.Case) -> None:
                nonlocal answered
                response = case.call(base_url=url, headers=headers, timeout=60)
                case.validate_response(response, checks=CHECKS)
                answered += 1

            run()
    return answered


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
            answered = await asyncio.to_thread(ask, document, site.url.rstrip("/"), site.token)
    assert answered > len(document["paths"])
    assert not log.found
