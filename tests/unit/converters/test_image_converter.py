"""Images travel as PNG, and come as PNG, JPEG or fields."""

import io
import struct
import zlib
from typing import Any

import numpy as np
import pytest
from PIL import Image

from rce.ros.types import Message, TypeRegistry
from rce_robot.converters import ConversionError, Converters
from rce_robot.converters.image import MAX_PIXELS

KIND = TypeRegistry().message("sensor_msgs/Image")
IMAGES = Converters().of(KIND)
CHANNELS = {"mono8": 1, "8UC1": 1, "bayer_rggb8": 1, "mono16": 2, "16UC1": 2, "rgb8": 3, "bgr8": 3, "8UC3": 3}
CHANNELS |= {"rgba8": 4, "bgra8": 4, "8UC4": 4}


def message(encoding: str, width: int = 5, height: int = 3, padding: int = 0, **more: object) -> Message:
    step = width * CHANNELS.get(encoding, 4) + padding
    data = bytes((7 * index) % 256 for index in range(step * height))
    fields = {"width": width, "height": height, "encoding": encoding, "step": step, "data": data}
    return KIND.new(**({"header": {"seq": 9, "frame_id": "cämera"}} | fields | more))


def picture(mode: str = "RGB", size: tuple[int, int] = (4, 3), form: str = "PNG") -> bytes:
    file = io.BytesIO()
    Image.new(mode, size).save(file, form)
    return file.getvalue()


@pytest.mark.parametrize("encoding", CHANNELS)
def test_an_image_becomes_a_png_and_comes_back_whole(encoding: str) -> None:
    payload = KIND.serialize(message(encoding))
    value = IMAGES.encode(payload)
    assert value.startswith(b"\x89PNG\r\n")
    assert IMAGES.decode(value) == (payload, ())


def test_the_colours_of_a_png_are_right_for_other_programs() -> None:
    value = IMAGES.encode(KIND.serialize(message("bgr8", width=1, height=1, data=b"\x01\x02\x03", step=3)))
    assert Image.open(io.BytesIO(value)).getpixel((0, 0)) == (3, 2, 1)
    big = message("mono16", width=1, height=1, data=b"\x01\x02", step=2, is_bigendian=1)
    assert Image.open(io.BytesIO(IMAGES.encode(KIND.serialize(big)))).getpixel((0, 0)) == 0x0102


def test_padding_of_rows_is_left_out() -> None:
    value = IMAGES.encode(KIND.serialize(message("rgb8", padding=4)))
    back = KIND.deserialize(IMAGES.decode(value)[0])
    rows = np.frombuffer(message("rgb8", padding=4).data, np.uint8).reshape(3, 19)[:, :15]
    assert (back.step, back.data) == (15, rows.tobytes())


@pytest.mark.parametrize(
    "image",
    [
        message("32FC1"),
        message("mono8", data=b"short"),
        message("rgb8", step=1),
        message("mono8", width=0),
    ],
)
def test_what_a_png_cannot_hold_leaves_as_fields(image: Any) -> None:
    payload = KIND.serialize(image)
    value = IMAGES.encode(payload)
    assert value["encoding"] == image.encoding
    assert value["data"] == image.data
    assert IMAGES.decode(value) == (payload, ())


@pytest.mark.parametrize(
    ("data", "encoding"),
    [
        (picture("L"), "mono8"),
        (picture("1"), "mono8"),
        (picture("I;16"), "mono16"),
        (picture("RGB"), "rgb8"),
        (picture("RGBA"), "rgba8"),
        (picture("LA"), "rgba8"),
        (picture("P"), "rgb8"),
        (picture("RGB", form="JPEG"), "rgb8"),
        (picture("L", form="JPEG"), "mono8"),
        (picture("CMYK", form="JPEG"), "rgb8"),
    ],
)
def test_pictures_of_other_programs_are_taken(data: Any, encoding: str) -> None:
    image = KIND.deserialize(IMAGES.decode(memoryview(data))[0])
    assert (image.width, image.height, image.encoding) == (4, 3, encoding)
    assert image.step * image.height == len(image.data)


def _bomb(width: int, height: int, colour: int = 0) -> bytes:
    head = struct.pack(">IIBBBBB", width, height, 8, colour, 0, 0, 0)
    chunks = ((b"IHDR", head), (b"IDAT", zlib.compress(b"\0")), (b"IEND", b""))
    made = (struct.pack(">I", len(b)) + k + b + struct.pack(">I", zlib.crc32(k + b)) for k, b in chunks)
    return b"\x89PNG\r\n\x1a\n" + b"".join(made)


@pytest.mark.parametrize(
    ("data", "part"),
    [
        (b"nonsense", "neither PNG nor JPEG"),
        (picture(form="GIF"), "neither PNG nor JPEG"),
        (picture("L", (64, 64))[:-40], "damaged"),
        (_bomb(MAX_PIXELS, 2), "pixels"),
        (_bomb(5000, 5000, 6), "pixels take 100000000 bytes"),
        (_bomb(10**5, 10**5), "too large"),
        ("cG5n", "PNG or JPEG as binary value, or an object"),
        (5, "PNG or JPEG as binary value, or an object"),
    ],
)
def test_what_is_no_picture_is_refused(data: object, part: str) -> None:
    with pytest.raises(ConversionError, match=part):
        IMAGES.decode(data)


def test_a_header_text_that_is_wrong_is_refused() -> None:
    notes = Image.new("L", (1, 1))
    file = io.BytesIO()
    from PIL.PngImagePlugin import PngInfo

    info = PngInfo()
    info.add_text("rce:header", '{"seq": "a"}')
    notes.save(file, "PNG", pnginfo=info)
    with pytest.raises(ConversionError, match=r"header\.seq: 'a' is not a uint32"):
        IMAGES.decode(file.getvalue())
    info.add_text("rce:header", "{")
    file = io.BytesIO()
    notes.save(file, "PNG", pnginfo=info)
    with pytest.raises(ConversionError, match="is not JSON"):
        IMAGES.decode(file.getvalue())


def test_an_image_inside_a_message_is_a_binary_value_too() -> None:
    kind = TypeRegistry().message("stereo_msgs/DisparityImage")
    codec = Converters().of(kind)
    payload, unknown = codec.decode({"image": picture("L"), "f": 2.0})
    assert unknown == ()
    value = codec.encode(payload)
    assert isinstance(value["image"], bytes)
    assert codec.decode(value)[0] == payload
    with pytest.raises(ConversionError, match="image: the binary value is neither PNG nor JPEG"):
        codec.decode({"image": b"x"})
