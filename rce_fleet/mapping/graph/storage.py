"""Graph maps in files: one ``.npz`` with all keyscans, their poses and edges."""

from __future__ import annotations

import json
import zipfile
import zlib
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rce_fleet.exceptions import MapError
from rce_fleet.mapping.graph.key_graph import Edge, KeyGraph
from rce_fleet.mapping.graph.scan_points import ScanPoints

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

FORMAT = "rce graph map"
VERSION = 1
SHAPES = {
    "poses": (None, 3),
    "robots": (None,),
    "ways": (None,),
    "lasers": (None, 5),
    "point_counts": (None,),
    "points": (None, 4),
    "range_counts": (None,),
    "ranges": (None,),
    "edge_ends": (None, 2),
    "edge_poses": (None, 3),
    "edge_information": (None, 3, 3),
    "edge_lengths": (None,),
    "edge_kinds": (None,),
}
"""Arrays of a file and their shapes. ``lasers``: x, y, yaw, angle_min, angle_increment; ``points``: x, y
and normal; ``edge_kinds``: 0 front end, 1 loop, 2 refinement."""
OF_KEYS = ("robots", "ways", "lasers", "point_counts", "range_counts")
OF_EDGES = ("edge_poses", "edge_information", "edge_lengths", "edge_kinds")
LOOP = 1
REFINED = 2


def save_graph(graph: KeyGraph, path: Path) -> None:
    """Write a graph map; an older file of this name is replaced when the new one is complete.

    Args:
        graph: The graph; not empty.
        path: File to write.

    Raises:
        MapError: The graph is empty, or the file cannot be written.
    """
    if not len(graph):
        raise MapError(f"{path}: the map has no scans yet, so there is nothing to save")
    edges = [*graph.edges, *graph.refined]
    kinds = [int(edge.is_loop) for edge in graph.edges] + [REFINED] * len(graph.refined)
    scans = graph.scans
    arrays: dict[str, Any] = {
        "header": np.array(json.dumps({"format": FORMAT, "version": VERSION})),
        "poses": graph.poses,
        "robots": np.array(graph.robots, np.int64),
        "ways": np.array(graph.ways, np.float64),
        "lasers": np.array([(*scan.laser, scan.angle_min, scan.angle_increment) for scan in scans]),
        "point_counts": np.array([len(scan) for scan in scans], np.int64),
        "points": np.concatenate([np.hstack((scan.points, scan.normals)) for scan in scans]).astype(
            np.float32
        ),
        "range_counts": np.array([len(scan.ranges) for scan in scans], np.int64),
        "ranges": np.concatenate([scan.ranges for scan in scans]),
        "edge_ends": np.array([(edge.first, edge.second) for edge in edges], np.int64).reshape(-1, 2),
        "edge_poses": np.array([edge.pose for edge in edges]).reshape(-1, 3),
        "edge_information": np.array([edge.information for edge in edges]).reshape(-1, 3, 3),
        "edge_lengths": np.array([edge.length for edge in edges]),
        "edge_kinds": np.array(kinds, np.int8),
    }
    partial = path.with_name(path.name + ".part")
    try:
        with partial.open("wb") as file:
            np.savez_compressed(file, allow_pickle=False, **arrays)
        partial.replace(path)
    except OSError as error:
        raise MapError(f"{path}: cannot be written: {error.strerror or error}") from error


def load_graph(path: Path) -> KeyGraph:
    """Read a graph map.

    Raises:
        MapError: The file cannot be read, or is not a graph map of this version.
    """
    try:
        with path.open("rb") as raw, np.load(raw, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
    except OSError as error:
        raise MapError(f"{path}: cannot be read: {error.strerror or error}") from error
    except (ValueError, EOFError, KeyError, RuntimeError, zipfile.BadZipFile, zlib.error) as error:
        raise MapError(f"{path}: is damaged or not a graph map (.npz): {error}") from error
    _check(path, arrays)
    return _graph(arrays)


def _check(path: Path, arrays: dict[str, NDArray[Any]]) -> None:
    try:
        header = json.loads(str(arrays["header"]))
        found = (header["format"], header["version"])
    except (KeyError, TypeError, ValueError) as error:
        raise MapError(f"{path}: is not a graph map: it has no header of one") from error
    if found != (FORMAT, VERSION):
        raise MapError(
            f"{path}: expected a '{FORMAT}' of version {VERSION}, found a '{found[0]}' of version {found[1]}"
        )
    for name, shape in SHAPES.items():
        array = arrays.get(name)
        has_shape = array is not None and array.ndim == len(shape) and array.shape[1:] == shape[1:]
        if array is None or not has_shape or array.dtype.kind not in "iuf":
            what = "nothing" if array is None else f"{array.dtype} of shape {array.shape}"
            raise MapError(f"{path}: expected '{name}' of shape {shape}, found {what}")
        if name != "ranges" and not np.isfinite(array).all():
            raise MapError(f"{path}: '{name}' has values that are not finite")
    keys, edges = len(arrays["poses"]), len(arrays["edge_ends"])
    for names, count in ((OF_KEYS, keys), (OF_EDGES, edges)):
        _check_counts(path, arrays, names, count)
    for name, counts in (("points", "point_counts"), ("ranges", "range_counts")):
        expected = int(arrays[counts].sum())
        if len(arrays[name]) != expected or (arrays[counts] < 0).any():
            raise MapError(f"{path}: expected {expected} rows in '{name}', found {len(arrays[name])}")
    ends = arrays["edge_ends"]
    if keys == 0 or (edges and not (ends.min() >= 0 and ends.max() < keys)):
        raise MapError(f"{path}: an edge is between keyscans that the map of {keys} keyscans does not have")


def _check_counts(path: Path, arrays: dict[str, NDArray[Any]], names: Sequence[str], count: int) -> None:
    for name in names:
        if len(arrays[name]) != count:
            raise MapError(f"{path}: expected {count} rows in '{name}', found {len(arrays[name])}")


def _graph(arrays: dict[str, NDArray[Any]]) -> KeyGraph:
    graph = KeyGraph()
    points = np.split(arrays["points"].astype(np.float64), np.cumsum(arrays["point_counts"])[:-1])
    ranges = np.split(arrays["ranges"].astype(np.float32), np.cumsum(arrays["range_counts"])[:-1])
    for number, laser in enumerate(arrays["lasers"].tolist()):
        scan = ScanPoints(
            points=points[number][:, :2],
            normals=points[number][:, 2:],
            ranges=np.where(np.isnan(ranges[number]), np.float32(inf), ranges[number]),
            angle_min=laser[3],
            angle_increment=laser[4],
            laser=(laser[0], laser[1], laser[2]),
        )
        graph.add(scan, arrays["poses"][number], int(arrays["robots"][number]), float(arrays["ways"][number]))
    for number, (first, second) in enumerate(arrays["edge_ends"].tolist()):
        kind = int(arrays["edge_kinds"][number])
        edge = Edge(
            first,
            second,
            arrays["edge_poses"][number],
            arrays["edge_information"][number],
            float(arrays["edge_lengths"][number]),
            is_loop=kind in {LOOP, REFINED},
        )
        if kind == REFINED:
            graph.refined.append(edge)
        else:
            graph.join(edge)
    # Joining moved parts; the file's poses are the optimized ones.
    graph.poses[:] = arrays["poses"]
    return graph
