"""Images for the camera, and which conditions are measured."""

from __future__ import annotations

import io
import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from rce_fleet.experiments.experiment import Options
from rce_fleet.experiments.images import JPEG, PNG, RAW, Images, parts, picture, shot_of, write_images
from rce_fleet.experiments.results import Condition
from rce_robot.conversion.pool import ConversionSettings


def test_pictures_differ_and_compress_as_a_cameras() -> None:
    first, second = picture(160, 120, 0), picture(160, 120, 1)
    assert first.shape == (120, 160, 3)
    assert not np.array_equal(first, second)
    assert np.array_equal(first, picture(160, 120, 0))
    raw, jpeg = shot_of(first, RAW), shot_of(first, JPEG)
    assert len(raw.data) == 160 * 120 * 3
    assert 0.02 < len(jpeg.data) / len(raw.data) < 0.3
    assert Image.open(io.BytesIO(jpeg.data)).size == (160, 120)


def test_the_list_names_each_image(tmp_path: Path) -> None:
    write_images(tmp_path / "camera.jsonl", [JPEG, RAW], ["160x120"])
    lines = [json.loads(line) for line in (tmp_path / "camera.jsonl").read_text().splitlines()]
    assert {line["stream"] for line in lines} == {"jpeg 160x120", "raw 160x120"}
    assert len({line["file"] for line in lines}) == len(lines) == 6
    raw = next(line for line in lines if line["stream"] == "raw 160x120")
    assert raw["fields"] == {"height": 120, "width": 160, "encoding": "rgb8", "step": 480}
    assert len((tmp_path / raw["file"]).read_bytes()) == 120 * 480


@pytest.mark.parametrize("quick", [False, True])
def test_only_an_engine_has_png(quick: bool) -> None:
    options = Options(quick=quick)
    encodings = {
        system: {part.factors["encoding"] for part in parts(options, setup_of(system))}
        for system in ("cloud", "single_master")
    }
    assert encodings == {"cloud": {RAW, JPEG, PNG}, "single_master": {RAW, JPEG}}
    factors = [tuple(part.factors.items()) for part in parts(options, setup_of("cloud"))]
    assert len(set(factors)) == len(factors)


def test_rate_above_the_link_comes_last() -> None:
    """What it leaves in queues counts in no other part."""
    rates = [part.factors["rate"] for part in parts(Options(), setup_of("cloud"))]
    assert rates.count("above") == 1
    assert rates[-1] == "above"


def test_png_comes_while_the_converters_worker_is_there() -> None:
    """Else the worker's start would count as the work for an image."""
    measured = parts(Options(), setup_of("cloud"))
    (at,) = (number for number, part in enumerate(measured) if part.factors["encoding"] == PNG)
    before = sum(part.seconds(Options().seconds) + 1 / part.rate for part in measured[:at])
    assert before < 0.5 * ConversionSettings().idle


def test_further_software_has_the_main_condition_only() -> None:
    options = Options(software=("ros", "rce"))
    assert parts(options, setup_of("cloud", "rce")) == parts(options, setup_of("cloud"))[:1]
    assert {setup.software for setup in Images().setups(options)} == {"ros", "rce"}
    assert {setup.software for setup in Images().setups(Options(quick=True))} == {"ros"}


def setup_of(system: str, software: str = "ros") -> Condition:
    return Condition.of("images", system, software)
