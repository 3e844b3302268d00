"""ROS's map files: map.yaml with a PGM or PNG image."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import numpy as np
import pytest
import yaml
from PIL import Image

from rce_fleet.exceptions import MapError
from rce_fleet.geometry.poses import Pose
from rce_fleet.maps.occupancy_map import OccupancyMap
from rce_fleet.maps.ros_map import load_map, save_map

HEADER: dict[str, object] = {
    "image": "map.pgm",
    "resolution": 0.05,
    "origin": [-1.0, -2.0, 0.5],
    "negate": 0,
    "occupied_thresh": 0.65,
    "free_thresh": 0.196,
}


def write(folder: Path, pixels: object, *, name: str = "map.pgm", **keys: object) -> Path:
    Image.fromarray(np.asarray(pixels, np.uint8)).save(folder / name)
    path = folder / "map.yaml"
    path.write_text(yaml.safe_dump({**HEADER, "image": name, **keys}))
    return path


def test_a_saved_map_is_loaded_again(tmp_path: Path) -> None:
    data = np.random.default_rng(1).choice(np.array([-1, 0, 100], np.int8), (7, 5))
    written = save_map(OccupancyMap(data, 0.025, Pose(1.5, -2.0, 0.25)), tmp_path / "hall")
    again = load_map(written)
    assert written == tmp_path / "hall.yaml"
    assert np.array_equal(again.data, data)
    assert (again.resolution, again.origin) == (0.025, Pose(1.5, -2.0, 0.25))
    assert (tmp_path / "hall.pgm").read_bytes().startswith(b"P5\n5 7\n255\n")


def test_the_upper_row_of_the_image_is_the_highest(tmp_path: Path) -> None:
    path = write(tmp_path, [[0, 254], [205, 254]])
    assert load_map(path).data.tolist() == [[-1, 0], [100, 0]]


@pytest.mark.parametrize(
    ("mode", "negate", "values"),
    [
        ("trinary", 0, [100, 100, -1, -1, 0, 0]),
        ("trinary", 1, [0, -1, -1, 100, 100, 100]),
        ("scale", 0, [100, 100, 66, 1, 0, 0]),
    ],
)
def test_shades_become_values_as_in_map_server(
    tmp_path: Path, mode: str, negate: int, values: list[int]
) -> None:
    path = write(tmp_path, [[0, 80, 128, 205, 206, 255]], mode=mode, negate=negate, free_thresh=0.195)
    found = load_map(path).data[0].tolist()
    assert found == values


def test_raw_pixels_are_the_values(tmp_path: Path) -> None:
    assert load_map(write(tmp_path, [[0, 50, 100, 255]], mode="raw")).data.tolist() == [[0, 50, 100, -1]]
    with pytest.raises(MapError, match=r"within 0 \.\. 100"):
        load_map(write(tmp_path, [[0, 150]], mode="raw"))


def test_colours_and_transparent_pixels(tmp_path: Path) -> None:
    black, white, clear = (0, 0, 0, 255), (255, 255, 255, 255), (255, 255, 255, 0)
    path = write(tmp_path, [[black, white, clear]], name="map.png", mode="scale", free_thresh=0.1)
    assert load_map(path).data.tolist() == [[100, 0, 0]]
    grey = (128, 128, 128, 0)
    path = write(tmp_path, [[black, white, grey]], name="map.png", mode="scale", free_thresh=0.1)
    assert load_map(path).data.tolist() == [[100, 0, -1]]


def test_a_palette_has_no_alpha_channel(tmp_path: Path) -> None:
    """Programs that make images smaller save greys with a palette; unknown pixels stay unknown."""
    path = write(tmp_path, [[0]], name="map.png")
    Image.fromarray(np.array([[0, 205, 254]], np.uint8)).convert("P").save(tmp_path / "map.png")
    assert load_map(path).data.tolist() == [[100, -1, 0]]


@pytest.mark.parametrize(
    ("keys", "fault"),
    [
        ({"resolution": -0.05}, "'resolution' must be a positive number of metres, not -0.05"),
        ({"resolution": 0}, "'resolution' must be a positive number of metres, not 0"),
        ({"resolution": True}, "'resolution' must be a number, not True"),
        ({"resolution": "wide"}, "'resolution' must be a number, not 'wide'"),
        ({"resolution": float("nan")}, "'resolution' must be a number, not nan"),
        ({"origin": [0, 0]}, r"'origin' must be \[x, y, yaw\]"),
        ({"origin": [0, 0, "left"]}, r"'origin\[2\]' must be a number, not 'left'"),
        ({"free_thresh": 0.7}, r"must be within 0 \.\. 1, in this order"),
        ({"occupied_thresh": None}, "'occupied_thresh' must be a number, not None"),
        ({"mode": "colour"}, "'mode' must be one of trinary, scale, raw, not 'colour'"),
        ({"image": 3}, "'image' must be the name"),
        ({"image": "gone.pgm"}, "gone.pgm cannot be read"),
    ],
)
def test_a_faulty_header_names_the_key(tmp_path: Path, keys: dict[str, object], fault: str) -> None:
    path = write(tmp_path, [[0]])
    path.write_text(yaml.safe_dump({**HEADER, **keys}))
    with pytest.raises(MapError, match=fault):
        load_map(path)


@pytest.mark.parametrize(
    ("image", "fault"),
    [
        (b"hello", "is not an image"),
        (b"P5\n4 4\n255\n123", "cannot be read"),
        (b"P5\n-3 4\n255\n123", "read|image"),
        (b"P5\n0 4\n255\n", "is not an image"),
        (b"P5\nwide 4\n255\n123", "cannot be read"),
        (b"P5\n100000 100000\n255\n123", "cannot be read: Image size"),
        (b"P9\n4 4\n255\n" + bytes(16), "is not an image"),
        (b"", "is not an image"),
    ],
)
def test_a_faulty_image_names_the_file(tmp_path: Path, image: bytes, fault: str) -> None:
    path = write(tmp_path, [[0]])
    (tmp_path / "map.pgm").write_bytes(image)
    with pytest.raises(MapError, match=fault) as caught:
        load_map(path)
    assert "map.pgm" in str(caught.value)


@pytest.mark.parametrize(("negate", "value"), [(True, 0), (False, 100), (1, 0), (0, 100)])
def test_negate_may_be_a_number_or_a_bool(tmp_path: Path, negate: bool | int, value: int) -> None:
    path = write(tmp_path, [[0]])
    path.write_text(yaml.safe_dump({**HEADER, "negate": negate}))
    assert load_map(path).data.tolist() == [[value]]


def test_files_that_hold_no_map(tmp_path: Path) -> None:
    with pytest.raises(MapError, match="cannot be read: No such file"):
        load_map(tmp_path / "map.yaml")
    (tmp_path / "map.yaml").write_text("- 1")
    with pytest.raises(MapError, match="must hold keys"):
        load_map(tmp_path / "map.yaml")
    with pytest.raises(MapError, match="cannot be written"):
        save_map(OccupancyMap(np.zeros((1, 1), np.int8)), tmp_path / "gone" / "map")


@pytest.mark.parametrize("mode", ["trinary", "scale", "raw"])
def test_a_large_map_takes_few_bytes_for_a_pixel(tmp_path: Path, mode: str) -> None:
    """A floor of 500 m at 5 cm is 100 MB; numbers of 64 bits made more than 2 GB of it."""
    pixels = np.random.default_rng(1).integers(0, 101, (1000, 1000)).astype(np.uint8)
    path = write(tmp_path, pixels, mode=mode)
    tracemalloc.start()
    try:
        grid = load_map(path)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert grid.data.shape == pixels.shape
    assert peak < 8 * pixels.size
