"""Map files as ROS's ``map_server`` reads and ``map_saver`` writes them: ``map.yaml`` and an image.

Format: http://wiki.ros.org/map_server. The image's upper row is the map's highest one.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from enum import StrEnum
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import yaml
from PIL import Image, UnidentifiedImageError

from rce_fleet.exceptions import MapError
from rce_fleet.geometry.poses import Pose
from rce_fleet.maps.occupancy_map import (
    FREE,
    FREE_UP_TO,
    MAX_CELLS,
    OCCUPIED,
    OCCUPIED_FROM,
    UNKNOWN,
    OccupancyMap,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

_WHITE = 255
_PIXEL_FREE, _PIXEL_OCCUPIED, _PIXEL_UNKNOWN = 254, 0, 205
_SAVED_OCCUPIED_THRESHOLD, _SAVED_FREE_THRESHOLD = 0.65, 0.196


class MapMode(StrEnum):
    """What the values of pixels become: three values, 0 .. 100, or themselves."""

    TRINARY = "trinary"
    SCALE = "scale"
    RAW = "raw"


@dataclass(frozen=True, slots=True)
class MapHeader:
    """The contents of a ``map.yaml``.

    Attributes:
        image: The image's file.
        resolution: Edge of a pixel, metres.
        origin: Pose of the lower left corner.
        negate: Whether white is occupied instead of black.
        occupied_thresh: Darker pixels are occupied; 0 is white, 1 black.
        free_thresh: Lighter pixels are free.
        mode: What the values of pixels become.
    """

    image: Path
    resolution: float
    origin: Pose
    negate: bool
    occupied_thresh: float
    free_thresh: float
    mode: MapMode = MapMode.TRINARY


def load_map(path: Path | str) -> OccupancyMap:
    """Read a map from its ``map.yaml``.

    Raises:
        MapError: The file or its image cannot be read; the text names the file, the key and what is expected.
    """
    header = read_header(Path(path))
    pixels = _pixels(header.image)
    if pixels.dtype == np.uint8:
        values = _values_of_grey(np.asarray(pixels, np.uint8), header)
    else:
        values = _values(np.asarray(pixels, np.float64), header)
    return OccupancyMap(values[::-1], header.resolution, header.origin)


def save_map(
    grid: OccupancyMap,
    path: Path | str,
    *,
    occupied_from: int = OCCUPIED_FROM,
    free_up_to: int = FREE_UP_TO,
) -> Path:
    """Write ``NAME.yaml`` and ``NAME.pgm`` as ``map_saver`` does: black occupied, white free, grey the rest.

    Args:
        grid: The map.
        path: ``NAME`` or ``NAME.yaml``. Its folder must exist.
        occupied_from: Values from here on are occupied.
        free_up_to: Values from 0 to here are free.

    Returns:
        The file ``NAME.yaml``.

    Raises:
        MapError: A file cannot be written.
    """
    target = Path(path)
    name = target.name.removesuffix(".yaml")
    pixels = np.full(grid.data.shape, _PIXEL_UNKNOWN, np.uint8)
    pixels[(grid.data >= FREE) & (grid.data <= free_up_to)] = _PIXEL_FREE
    pixels[grid.data >= occupied_from] = _PIXEL_OCCUPIED
    header = {
        "image": f"{name}.pgm",
        "resolution": grid.resolution,
        "origin": [grid.origin.x, grid.origin.y, grid.origin.yaw],
        "negate": 0,
        "occupied_thresh": _SAVED_OCCUPIED_THRESHOLD,
        "free_thresh": _SAVED_FREE_THRESHOLD,
    }
    try:
        Image.fromarray(np.ascontiguousarray(pixels[::-1])).save(target.with_name(f"{name}.pgm"))
        written = target.with_name(f"{name}.yaml")
        written.write_text(yaml.safe_dump(header, sort_keys=False, default_flow_style=None), "utf-8")
    except OSError as error:
        raise MapError(f"the map cannot be written to {target.parent}: {error}") from error
    return written


# The yaml file


def read_header(path: Path) -> MapHeader:
    """Read a ``map.yaml`` without its image.

    Raises:
        MapError: As of :func:`load_map`.
    """
    try:
        found = yaml.safe_load(path.read_text("utf-8"))
    except OSError as error:
        raise MapError(f"{path} cannot be read: {error.strerror}") from error
    except (UnicodeDecodeError, yaml.YAMLError) as error:
        raise MapError(f"{path} is not YAML text: {error}") from error
    if not isinstance(found, dict):
        raise MapError(f"{path} must hold keys such as 'image' and 'resolution', not {type(found).__name__}")
    image = found.get("image")
    if not isinstance(image, str) or not image:
        raise MapError(f"{path}: 'image' must be the name of the map's image, not {image!r}")
    resolution = _number(path, found, "resolution")
    if resolution <= 0:
        raise MapError(f"{path}: 'resolution' must be a positive number of metres, not {resolution}")
    free, occupied = _number(path, found, "free_thresh"), _number(path, found, "occupied_thresh")
    if not 0 <= free <= occupied <= 1:
        raise MapError(
            f"{path}: 'free_thresh' {free} and 'occupied_thresh' {occupied} must be within 0 .. 1,"
            " in this order"
        )
    mode = found.get("mode", MapMode.TRINARY)
    if mode not in tuple(MapMode):
        raise MapError(f"{path}: 'mode' must be one of {', '.join(MapMode)}, not {mode!r}")
    return MapHeader(
        path.parent / image,
        resolution,
        _origin(path, found),
        found["negate"] if isinstance(found.get("negate"), bool) else bool(_number(path, found, "negate", 0)),
        occupied,
        free,
        MapMode(mode),
    )


def _number(path: Path, found: dict[object, object], key: str, default: float | None = None) -> float:
    value = found.get(key, default)
    if isinstance(value, str):
        with suppress(ValueError):  # YAML 1.1 takes 5e-2 for a text; any other text is refused below
            value = float(value)
    if isinstance(value, bool) or not isinstance(value, int | float) or not isfinite(value):
        raise MapError(f"{path}: '{key}' must be a number, not {value!r}")
    return float(value)


def _origin(path: Path, found: dict[object, object]) -> Pose:
    value = found.get("origin")
    if not isinstance(value, list) or len(value) != 3:  # noqa: PLR2004  # x, y, yaw
        raise MapError(f"{path}: 'origin' must be [x, y, yaw] of the lower left corner, not {value!r}")
    parts: dict[object, object] = {f"origin[{index}]": part for index, part in enumerate(value)}
    return Pose(*(_number(path, parts, f"origin[{index}]") for index in range(3)))


# The image


def _pixels(path: Path) -> NDArray[np.uint8] | NDArray[np.float64]:
    """Return the image's bytes, 0 .. 255: shape (height, width) if it is grey, else (..., channels)."""
    try:
        with Image.open(path) as image:
            width, height = image.size
            if width * height > MAX_CELLS:
                raise MapError(f"{path}: {width} x {height} pixels are more than {MAX_CELLS}")
            wide = image.mode.startswith("I")  # 16 bits
            if image.mode in ("1", "L"):
                return np.asarray(image.convert("L"), np.uint8)
            if not wide and image.mode not in ("LA", "RGB", "RGBA"):
                # An alpha channel counts as a colour: only an image that has transparency gets one.
                mode = "RGBA" if image.has_transparency_data else "RGB"
                pixels = np.asarray(image.convert(mode), np.float64)
            else:
                pixels = np.asarray(image, np.float64)
    except UnidentifiedImageError as error:
        raise MapError(f"{path} is not an image that can be read, such as PGM or PNG") from error
    except (OSError, ValueError, Image.DecompressionBombError) as error:
        raise MapError(f"the map's image {path} cannot be read: {error}") from error
    if wide:
        pixels = pixels * (_WHITE / 65535)
    return pixels[..., None] if pixels.ndim == 2 else pixels  # noqa: PLR2004  # rows and columns


def _values_of_grey(pixels: NDArray[np.uint8], header: MapHeader) -> NDArray[np.int8]:
    """Return values of cells of a grey image, shape (height, width), without numbers larger than a byte.

    A floor of 500 m has a hundred million pixels.
    """
    is_used = np.zeros(_WHITE + 1, np.bool_)
    is_used[pixels] = True
    shades = np.flatnonzero(is_used)
    table = np.zeros(_WHITE + 1, np.int8)
    table[shades] = _values(shades.astype(np.float64)[:, None, None], header)[:, 0]
    return np.asarray(table[pixels])


def _values(pixels: NDArray[np.float64], header: MapHeader) -> NDArray[np.int8]:
    """Return values of cells, the image's upper row first.

    As in ``map_server``, an alpha channel counts as one more colour in the mode ``trinary``. In ``scale``
    a fully transparent pixel between the thresholds is unknown.
    """
    channels = pixels.shape[2]
    has_alpha = channels in (2, 4)
    colours = pixels if header.mode is MapMode.TRINARY or not has_alpha else pixels[..., :-1]
    shade = colours.mean(axis=2)
    if header.negate:
        shade = _WHITE - shade
    if header.mode is MapMode.RAW:
        if shade.max() > OCCUPIED and not (shade[shade > OCCUPIED] == _WHITE).all():
            raise MapError(
                f"{header.image}: in the mode 'raw' pixels must be within 0 .. 100, or 255 for unknown"
            )
        shade[shade > OCCUPIED] = UNKNOWN
        return np.asarray(shade.astype(np.int8))
    dark = (_WHITE - shade) / _WHITE
    if header.mode is MapMode.SCALE:
        width = max(header.occupied_thresh - header.free_thresh, 1e-9)
        values = 1 + 98 * (dark - header.free_thresh) / width
        if has_alpha:
            values[pixels[..., -1] == 0] = UNKNOWN
    else:
        values = np.full(dark.shape, float(UNKNOWN))
    values[dark < header.free_thresh] = FREE
    values[dark > header.occupied_thresh] = OCCUPIED
    return np.asarray(values.astype(np.int8))
