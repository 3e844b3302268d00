"""Tests of mapping run the compiled loops; those of the loops themselves compare them with numpy's."""

from __future__ import annotations

import pytest

from rce_fleet.compiled import compile_kernels
from rce_fleet.mapping.graph.fields import paint
from rce_fleet.mapping.graph.search import search


@pytest.fixture(scope="session", autouse=True)
def compiled_graph_kernels() -> None:
    """Compile what graph mapping uses, if numba is there."""
    compile_kernels([paint, search])
