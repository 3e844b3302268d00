"""Messages of layers: what the page gets of them, and what is wrong with bad ones."""

from __future__ import annotations

import json
import zlib
from math import inf, nan, pi
from typing import Any

import numpy as np
import pytest
from support.layers import RANGES, RESOLUTION, grid, header, pose, room, scan

from rce.ros.packages import PackageIndex
from rce.ros.types import TypeRegistry
from rce_fleet.station.layers import decoding
from rce_fleet.station.layers.decoding import LayerDecoder, coarser
from rce_fleet.station.layers.frames import LayerData, LayerError, Placement, encode, stamp_note
from rce_fleet.station.layers.kinds import LAYERS

TYPES = TypeRegistry(PackageIndex([]))
STAMP = 1_700_000_000.25


def written(type_name: str, fields: dict[str, Any]) -> bytes:
    kind = TYPES.message(type_name)
    return kind.serialize(kind.new(**fields))


def decoded(layer: str, **fields: Any) -> LayerData:
    kind = LAYERS[layer]
    return LayerDecoder(kind, TYPES).decode(written(kind.topic.type_name, fields))


def cells_of(data: LayerData) -> np.ndarray[Any, np.dtype[np.uint8]]:
    values = np.frombuffer(zlib.decompress(data.numbers), np.uint8)
    return values.reshape(data.fields["rows"], data.fields["columns"])


def cloud(*poses: dict[str, Any]) -> dict[str, Any]:
    return {"header": header("map", STAMP), "poses": list(poses)}


def test_a_frame_is_header_and_aligned_numbers() -> None:
    data = decoded("scan", **scan("laser", STAMP))
    frame = encode("Robot1", "scan", data, Placement((1.0, 2.0, 0.5), "late"))
    length = int.from_bytes(frame[:4], "little")
    assert (4 + length) % 4 == 0
    shown = json.loads(frame[4 : 4 + length])
    assert (shown["robot"], shown["layer"], shown["frame"]) == ("Robot1", "scan", "laser")
    assert shown["pose"] == [1.0, 2.0, 0.5]
    assert shown["stamp"] == pytest.approx(STAMP)
    assert shown["notes"] == [f"1 of {RANGES} ranges are not a number", "late"]
    ranges = np.frombuffer(frame[4 + length :], "<f4")
    assert ranges.size == RANGES
    assert np.isinf(ranges[10])


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"angle_min": nan}, "angle_min"),
        ({"angle_increment": 0.0}, "angle_increment"),
        ({"angle_increment": inf}, "angle_increment"),
        ({"range_max": nan}, "range_max"),
        ({"ranges": [1.0] * (decoding.MAX_RANGES + 1)}, "at most"),
    ],
)
def test_a_scan_that_cannot_be_drawn_is_refused(changes: dict[str, Any], words: str) -> None:
    with pytest.raises(LayerError, match=words):
        decoded("scan", **scan("laser", STAMP, **changes))


def test_a_scan_of_another_length_is_drawn_with_a_note() -> None:
    data = decoded("scan", **scan("laser", STAMP, ranges=[1.0] * 100))
    assert data.notes == (f"100 ranges, but the angles are those of {RANGES}",)


def test_a_scanner_without_a_limit_is_drawn() -> None:
    assert decoded("scan", **scan("laser", STAMP, range_max=inf)).fields["range_max"] == 1e9


@pytest.mark.parametrize("layer", sorted(LAYERS))
def test_bytes_that_are_no_message_are_refused(layer: str) -> None:
    with pytest.raises(LayerError, match="is not a"):
        LayerDecoder(LAYERS[layer], TYPES).decode(b"\x01\x02\x03")


def test_particles_that_are_not_finite_are_left_out() -> None:
    zero = {"position": {"x": 1.0, "y": 1.0}, "orientation": {}}
    data = decoded("particles", **cloud(pose(1.0, 2.0, pi / 2), pose(nan, 0.0, 0.0), zero))
    assert np.frombuffer(data.numbers, "<f4") == pytest.approx([1.0, 2.0, pi / 2])
    assert data.notes == ("2 of 3 poses are not finite",)


def test_a_large_cloud_is_thinned_out() -> None:
    count = decoding.MAX_POSES * 2 + 1
    data = decoded("particles", **cloud(*[pose(1.0, 2.0, 0.0)] * count))
    assert data.fields["count"] <= decoding.MAX_POSES
    assert "every 3th" in data.notes[0]


def test_a_map_keeps_origin_and_rotation() -> None:
    data = decoded("map", **grid("map", STAMP, room(), pose(-1.0, 2.0, 0.3)))
    assert data.fields["origin"] == pytest.approx([-1.0, 2.0, 0.3])
    assert data.fields["resolution"] == pytest.approx(RESOLUTION)
    assert (cells_of(data) == room().view(np.uint8)).all()


def test_an_origin_without_orientation_is_not_turned() -> None:
    """As octomap_server publishes it."""
    origin = {"position": {"x": -1.0, "y": 2.0}, "orientation": {}}
    assert decoded("map", **grid("map", STAMP, room(), origin)).fields["origin"] == [-1.0, 2.0, 0.0]


@pytest.mark.parametrize(
    ("info", "words"),
    [
        ({"width": 3}, "3 x 160"),
        ({"width": 0}, "0 x 160"),
        ({"resolution": 0.0}, "resolution"),
        ({"resolution": nan}, "resolution"),
        ({"origin": pose(nan, 0.0, 0.0)}, "origin"),
    ],
)
def test_a_map_with_a_wrong_header_is_refused(info: dict[str, Any], words: str) -> None:
    fields = grid("map", STAMP, room(), pose(0.0, 0.0, 0.0))
    fields["info"] |= info
    with pytest.raises(LayerError, match=words):
        decoded("map", **fields)


def test_a_huge_map_is_sent_coarser(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(decoding, "MAX_CELLS", 5000)
    data = decoded("map", **grid("map", STAMP, room(), pose(0.0, 0.0, 0.0)))
    assert (data.fields["rows"], data.fields["resolution"]) == (54, pytest.approx(0.15))
    assert "3 x 3" in data.notes[0]


def test_walls_are_kept_in_a_coarser_grid() -> None:
    cells = np.full((5, 5), -1, np.int8)
    cells[4, 4], cells[0, 0] = 100, 0
    assert coarser(cells, 2).tolist() == [[0, -1, -1], [-1, -1, -1], [-1, -1, 100]]


def update(x: int, y: int, width: int, height: int, values: list[int]) -> bytes:
    fields = {"x": x, "y": y, "width": width, "height": height, "data": values}
    return written("map_msgs/OccupancyGridUpdate", {"header": header("map", STAMP), **fields})


def test_an_update_changes_a_part_of_a_costmap() -> None:
    kind = LAYERS["global_costmap"]
    decoder = LayerDecoder(kind, TYPES)
    assert decoder.update([update(1, 2, 2, 1, [5, 6])]) is None
    whole = grid("map", STAMP, np.zeros((4, 4), np.int8), pose(0.0, 0.0, 0.0))
    decoder.decode(written(kind.topic.type_name, whole))
    data = decoder.update([update(1, 2, 2, 1, [5, 6]), update(0, 0, 1, 1, [7])])
    assert data is not None
    assert cells_of(data)[2].tolist() == [0, 5, 6, 0]
    assert cells_of(data)[0, 0] == 7


@pytest.mark.parametrize(
    ("part", "words"),
    [((3, 3, 2, 1, [1, 2]), "does not fit"), ((-1, 0, 1, 1, [1]), "fit"), ((0, 0, 2, 2, [1]), "1 values")],
)
def test_an_update_that_does_not_fit_is_refused(part: Any, words: str) -> None:
    kind = LAYERS["local_costmap"]
    decoder = LayerDecoder(kind, TYPES)
    whole = grid("map", STAMP, np.zeros((4, 4), np.int8), pose(0.0, 0.0, 0.0))
    decoder.decode(written(kind.topic.type_name, whole))
    with pytest.raises(LayerError, match=words):
        decoder.update([update(*part)])


@pytest.mark.parametrize(
    ("stamp", "previous", "words"),
    [
        (1_700_000_000.0, 0.0, ""),
        (1_700_000_001.0, 1_700_000_000.0, ""),
        (1_700_000_000.0, 1_700_000_002.0, "2.0 s before"),
        (1_699_999_000.0, 0.0, "1000 s in the past"),
        (1_700_000_060.0, 0.0, "60 s in the future"),
        (12.5, 12.4, ""),
    ],
)
def test_stamps_are_compared_with_clock_and_order(stamp: float, previous: float, words: str) -> None:
    note = stamp_note(int(stamp * 1e9), int(previous * 1e9), 1_700_000_000.0)
    assert words in note
    assert bool(note) is bool(words)
