"""``rce compile``: compile all inner loops once, so that no node has to when it starts."""

from __future__ import annotations

import importlib
import os
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from time import perf_counter

import typer

from rce_fleet.compiled import INSTALLED, compile_for_all, is_available

MODULES = (
    (
        "rce_fleet.planning.lacam",
        "rce_fleet.planning.lifelong",
        "rce_fleet.planning.path_improvement_loops",
        "rce_fleet.planning.rerouting_loops",
        "rce_fleet.planning.visit_lists",
    ),
    (
        "rce_fleet.localization.clusters",
        "rce_fleet.localization.likelihood",
        "rce_fleet.localization.motion",
        "rce_fleet.localization.resampling",
        "rce_fleet.mapping.draw_kernels",
        "rce_fleet.mapping.graph.fields",
        "rce_fleet.mapping.graph.search",
        "rce_fleet.mapping.match_kernels",
        "rce_fleet.maps.ray_casting",
        "rce_fleet.navigation.planners.cost_to_go",
        "rce_fleet.tasks.matching",
        "rce_fleet.tasks.travel",
    ),
)
"""The modules that have inner loops, in parts that take about the same time."""


def compile_loops() -> None:
    """Compile the inner loops of the fleet's programs once, for this machine.

    Otherwise each node compiles what it uses when it starts. Run it after an update; what has not changed is
    not compiled again.
    """
    if not is_available():
        typer.echo("rce compile: numba is missing or turned off; run: pip install 'rce[compiled]'", err=True)
        raise typer.Exit(1)
    began = perf_counter()
    workers = min(len(MODULES), os.cpu_count() or 1)
    try:
        with ProcessPoolExecutor(workers, get_context("spawn")) as pool:
            list(pool.map(_compile, MODULES))
    except OSError as error:
        typer.echo(f"rce compile: cannot write to {INSTALLED}: {error.strerror or error}", err=True)
        raise typer.Exit(1) from error
    typer.echo(f"compiled inner loops in {perf_counter() - began:.1f} s, into {INSTALLED}")


def _compile(modules: tuple[str, ...]) -> None:
    """Compile the loops of these modules, in a process of its own."""
    for name in modules:
        importlib.import_module(name)
    compile_for_all()
