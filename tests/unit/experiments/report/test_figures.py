"""Figures and schematics: what is drawn, and the same files from the same rows."""

from __future__ import annotations

import re
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pytest
from PIL import Image
from support.experiment_rows import example_rows

from rce_fleet.experiments.report.drawing import DPI, Drawing, errors, save
from rce_fleet.experiments.report.figures import figures_of
from rce_fleet.experiments.report.measurements import Measurements
from rce_fleet.experiments.report.schematics import SET_UPS, schematics
from rce_fleet.experiments.results import Row

pytest.importorskip("matplotlib", reason="figures need rce[figures]")

pytestmark = pytest.mark.slow
"""They need what draws, which takes long to load."""

LABELS = {
    "laser-network-ros": {"SMS", "MMS", "CRS", "kB/s", "rate=free"},
    "laser-cpu-ros": {"SMS-S", "SMS-C", "MMS-S", "MMS-C", "CRS-S", "CRS-C", "cores", "7.50 Hz"},
    "round-trip-ros": {
        "SMS",
        "MMS",
        "CRS",
        "CRS, origin=container",
        "bytes",
        "origin=client",
        "origin=server",
    },
    "images-network-ros": {
        "SMS",
        "MMS",
        "CRS",
        "server.network_in + server.network_out",
        "MB/s",
        "640x480",
        "jpeg",
    },
    "images-cpu-ros": {"SMS", "MMS", "CRS", "cores", "server.cpu", "client.cpu", "160x120", "raw"},
    "scaling-ros": {"SMS", "MMS", "CRS", "robots", "received", "server.memory", "MB"},
    "robustness-ros": {"SMS", "MMS", "CRS", "topics", "services", "new topics", "s", "x"},
    "offload-ros": {"place=cloud", "place=robot", "rate in Mbit/s"},
}


def is_further(row: Row) -> bool:
    """Whether it makes further panels that are like others."""
    if row.condition.experiment == "scaling":
        return row.metric not in {"received", "server.memory"}
    return dict(row.condition.factors).get("client_cpu") == "all"


@pytest.fixture(scope="module")
def drawings() -> dict[str, Drawing]:
    """Each figure with few panels: a panel takes a quarter of a second."""
    rows = (row for row in example_rows(["ros"]) if not is_further(row))
    found = figures_of(Measurements.of(rows))
    return {drawing.name: drawing for group in found.values() for drawing in group}


@pytest.fixture(scope="module")
def folder(drawings: dict[str, Drawing], tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("figures")
    for drawing in [*drawings.values(), *schematics()]:
        save(drawing, folder)
    return folder


def texts_of(svg: Path) -> set[str]:
    """The lines of text in a figure; a text may also have parts of its own, as powers of ten do."""
    root = ET.fromstring(svg.read_text(encoding="utf-8"))  # also fails if it is not well-formed
    assert root.tag == "{http://www.w3.org/2000/svg}svg"
    return {"".join(text.itertext()).strip() for text in root.iter("{http://www.w3.org/2000/svg}text")}


def test_every_experiment_has_its_figures(drawings: dict[str, Drawing]) -> None:
    assert drawings.keys() == LABELS.keys()


@pytest.mark.parametrize("name", LABELS)
def test_svg_has_the_labels(name: str, folder: Path) -> None:
    assert LABELS[name] <= texts_of(folder / f"{name}.svg")


@pytest.mark.parametrize("name", LABELS)
def test_png_has_its_size_and_is_not_empty(name: str, folder: Path, drawings: dict[str, Drawing]) -> None:
    drawing = drawings[name]
    with Image.open(folder / f"{name}.png") as image:
        assert image.width == int(min(drawing.panels, drawing.columns) * drawing.panel[0] * DPI)
        pixels = np.asarray(image.convert("RGB")).reshape(-1, 3)
    assert (pixels == 255).all(axis=1).mean() < 0.98
    assert len(np.unique(pixels, axis=0)) > 20, "colours and their blends"


def test_schematics_name_all_programs(folder: Path) -> None:
    for drawing, set_up in zip(schematics(), SET_UPS.values(), strict=True):
        names = {program.name for program in set_up.programs} | {flow.text for flow in set_up.flows}
        assert names <= texts_of(folder / f"{drawing.name}.svg")


def test_flows_join_programs_of_their_set_up() -> None:
    for set_up in SET_UPS.values():
        names = {program.name for program in set_up.programs}
        assert len(names) == len(set_up.programs)
        assert {end for flow in set_up.flows for end in (flow.source, flow.target)} <= names


def test_same_rows_make_the_same_files(folder: Path, drawings: dict[str, Drawing], tmp_path: Path) -> None:
    again = {drawing.name: drawing for drawing in schematics()}
    for name in ("laser-cpu-ros", "images-network-ros", "set-up-cloud"):
        save({**drawings, **again}[name], tmp_path)
        for suffix in ("png", "svg"):
            assert (tmp_path / f"{name}.{suffix}").read_bytes() == (folder / f"{name}.{suffix}").read_bytes()


def test_files_have_no_date_and_no_version(folder: Path) -> None:
    for file in folder.glob("*.svg"):
        assert not re.search(r"<dc:date>|Matplotlib v", file.read_text(encoding="utf-8"))
    for file in folder.glob("*.png"):
        assert b"matplotlib" not in file.read_bytes().lower()


def test_no_rows_make_no_figures() -> None:
    assert figures_of(Measurements.of([])) == {}


@pytest.mark.usefixtures("folder")  # matplotlib keeps fonts open from then on
def test_one_run_is_drawn_without_interval(tmp_path: Path) -> None:
    rows = (row for row in example_rows(["ros"], spread=[1.0]) if not is_further(row))
    measurements = Measurements.of(rows)
    sample = measurements.sample(measurements.conditions("laser")[0], "rate")
    assert sample is not None
    assert errors([sample], 1.0) == [[0.0], [0.0]]
    (drawing, _) = figures_of(measurements)["laser"]
    save(drawing, tmp_path)
    assert (tmp_path / f"{drawing.name}.png").stat().st_size > 10_000
