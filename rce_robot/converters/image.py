"""``sensor_msgs/Image`` as a PNG.

An image leaves as a PNG binary value if a PNG can hold it (``mono8``, ``mono16``, ``rgb8``, ``bgr8``,
``rgba8``, ``bgra8``, the Bayer and the plain 8 and 16 bit unsigned encodings), else as its fields. The
header and the encoding travel in text chunks of the PNG, which other programs ignore, so that nothing is
lost between two robots. An image comes as PNG or JPEG, or as its fields.
"""

from __future__ import annotations

import io
import json
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from PIL.Image import Image

MAX_PIXELS = 1 << 25
"""Largest image that is decoded: a small file can hold a huge one."""
MAX_BYTES = 64 << 20
"""The same for its pixels in memory; larger messages are refused."""

_FAST = 1
"""Level of PNG compression; more costs much time and saves little on camera images."""

_ENCODING_KEY, _HEADER_KEY = "rce:encoding", "rce:header"


class _Layout(NamedTuple):
    mode: str
    """Pillow's name of the pixels."""
    raw: str
    """Pillow's name of their order in memory."""
    size: int
    """Bytes of a pixel."""


_GREY = _Layout("L", "L", 1)
_LAYOUTS = {
    "mono8": _GREY,
    "8UC1": _GREY,
    "mono16": _Layout("I;16", "I;16", 2),
    "16UC1": _Layout("I;16", "I;16", 2),
    "rgb8": _Layout("RGB", "RGB", 3),
    "bgr8": _Layout("RGB", "BGR", 3),
    "8UC3": _Layout("RGB", "BGR", 3),
    "rgba8": _Layout("RGBA", "RGBA", 4),
    "bgra8": _Layout("RGBA", "BGRA", 4),
    "8UC4": _Layout("RGBA", "BGRA", 4),
    **{f"bayer_{order}8": _GREY for order in ("rggb", "bggr", "gbrg", "grbg")},
}
_ENCODINGS = {"L": "mono8", "I;16": "mono16", "RGB": "rgb8", "RGBA": "rgba8"}
"""The default encoding of a picture, by Pillow's mode."""


class ImageConverter:
    """Custom converter of ``sensor_msgs/Image``."""

    def encode(self, fields: dict[str, Any]) -> Any:
        """Return the image as PNG, or its fields if a PNG cannot hold it."""
        layout = _LAYOUTS.get(fields["encoding"])
        width, height, step, data = (fields[key] for key in ("width", "height", "step", "data"))
        if layout is None or not width or not height:
            return fields
        if step < width * layout.size or len(data) < step * height:
            return fields
        from PIL import Image
        from PIL.PngImagePlugin import PngInfo

        raw = "I;16B" if layout.raw == "I;16" and fields["is_bigendian"] else layout.raw
        image = Image.frombytes(layout.mode, (width, height), bytes(data), "raw", raw, step, 1)
        notes = PngInfo()
        notes.add_text(_ENCODING_KEY, fields["encoding"])
        notes.add_text(_HEADER_KEY, json.dumps(fields["header"]))
        file = io.BytesIO()
        image.save(file, "PNG", compress_level=_FAST, pnginfo=notes)
        return file.getvalue()

    def decode(self, value: Any) -> dict[str, Any]:
        """Return the fields of a PNG or JPEG.

        Raises:
            ValueError: It is neither, is damaged, or is larger than :data:`MAX_PIXELS`.
        """
        if not isinstance(value, (bytes, bytearray, memoryview)):
            raise ValueError("an image is a PNG or JPEG as binary value, or an object of its fields")  # noqa: TRY004
        image, notes = _load(value)
        encoding = notes.get(_ENCODING_KEY, "")
        layout = _LAYOUTS.get(encoding)
        if layout is None or layout.mode != image.mode:
            encoding = _ENCODINGS[image.mode]
            layout = _LAYOUTS[encoding]
        return {
            "header": _header(notes.get(_HEADER_KEY)),
            "height": image.height,
            "width": image.width,
            "encoding": encoding,
            "is_bigendian": 0,
            "step": image.width * layout.size,
            "data": image.tobytes("raw", layout.raw),
        }


def _load(data: bytes | bytearray | memoryview) -> tuple[Image, dict[str, str]]:
    """Decode a picture into one of the modes of :data:`_ENCODINGS`; return it with its text chunks."""
    from PIL import Image, UnidentifiedImageError

    try:
        image = Image.open(io.BytesIO(data), formats=("PNG", "JPEG"))
        if image.width * image.height > MAX_PIXELS:
            raise ValueError(
                f"the image has {image.width} x {image.height} pixels, at most {MAX_PIXELS} are taken"
            )
        size = image.width * image.height * len(image.getbands())
        if size > MAX_BYTES:
            raise ValueError(f"the image's pixels take {size} bytes, at most {MAX_BYTES} are taken")
        image.load()
    except UnidentifiedImageError:
        raise ValueError("the binary value is neither PNG nor JPEG") from None
    except (Image.DecompressionBombError, Image.DecompressionBombWarning) as error:
        raise ValueError(f"the image is too large: {error}") from error
    except (OSError, SyntaxError, IndexError, EOFError) as error:
        raise ValueError(f"the image is damaged: {error}") from error
    notes = {str(key): str(text) for key, text in getattr(image, "text", {}).items()}
    if image.mode in _ENCODINGS:
        return image, notes
    if image.mode in ("1", "I"):
        return image.convert("L" if image.mode == "1" else "I;16"), notes
    return image.convert("RGBA" if image.has_transparency_data else "RGB"), notes


def _header(text: str | None) -> Any:
    if text is None:
        return {}
    try:
        return json.loads(text)
    except ValueError:
        raise ValueError(f"the PNG's {_HEADER_KEY} text is not JSON") from None
