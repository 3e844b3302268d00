"""The paper's second experiment: images from a camera on machine 2, shown on a console of machine 1."""

from __future__ import annotations

import io
import json
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from PIL import Image

from rce_fleet.experiments.bench import CLIENT, SERVER, Bench
from rce_fleet.experiments.experiment import SETTLE_S, START_S, Experiment, Measured, Options, Trial
from rce_fleet.experiments.streaming import Part, Streaming
from rce_fleet.experiments.systems.base import Flow, Workload
from rce_fleet.experiments.workloads.control import PRINTED, QUIET

if TYPE_CHECKING:
    from pathlib import Path

    from rce_fleet.experiments.results import Condition

RAW, PNG, JPEG = "raw", "png", "jpeg"
TOPICS = {
    RAW: ("/camera/image_raw", "sensor_msgs/Image"),
    JPEG: ("/camera/image_raw/compressed", "sensor_msgs/CompressedImage"),
    PNG: ("/camera/image_png", "sensor_msgs/Image"),
}
"""Topic and type of each encoding; PNG is made by a camera that is a client of the engine itself."""
SIZES = {"160x120": (160, 120), "640x480": (640, 480), "1920x1080": (1920, 1080)}
MAIN_SIZE = "640x480"
SHOTS = 3
"""Different images of each size."""
CARRIED_HZ = {"160x120": 20.0, "640x480": 3.0, "1920x1080": 0.5}
"""Rates at which a link of 50 Mbit/s carries raw images."""
ABOVE_HZ = 30.0
QUALITY = 80
NOISE = 4.0
"""Standard deviation of a pixel, of 255: a camera's images do not compress to nothing."""


class Images(Experiment):
    """Images in the three systems."""

    name = "images"
    title = "camera images, shown on a console of machine 1 (the paper's experiment 2)"
    programs = ("camera", "listener")

    def setups(self, options: Options) -> list[Condition]:
        """Return a set-up for each system and software; quickly, with the first one."""
        return self.each(options, software=options.software[:1] if options.quick else None)

    def seconds(self, setup: Condition, options: Options) -> float:
        """Return about how long a run takes."""
        return START_S + sum(
            part.seconds(options.seconds) + max(SETTLE_S, 1 / part.rate) for part in parts(options, setup)
        )

    async def measure(self, trial: Trial) -> list[Measured]:
        """Run a set-up once."""
        options = trial.options
        wanted = parts(options, trial.setup)
        encodings = sorted({part.factors["encoding"] for part in wanted})
        async with Bench(seed=trial.seed) as bench:
            flows = [Flow(*TOPICS[one], from_client=one == PNG) for one in encodings]
            control = bench.folder / "camera.json"
            topics = tuple(f"{flow.topic}={flow.kind}" for flow in flows)
            cameras = []
            for name, sent in (("camera", {RAW, JPEG}), ("camera_png", {PNG})):
                if wanted_of := sent & set(encodings):
                    file = bench.folder / f"{name}.jsonl"
                    write_images(file, sorted(wanted_of), sorted({part.factors["size"] for part in wanted}))
                    words = ("--control", str(control), "--images", str(file))
                    cameras.append(Workload(name, "camera", words, CLIENT, is_client=name != "camera"))
            listener, *sources = await trial.system(bench).start(
                flows, [Workload("listener", "listener", topics, SERVER), *cameras]
            )
            streaming = Streaming(bench, control, sources, [listener])
            found = await streaming.measure(wanted[: 1 if trial.is_warm_up else None], options.seconds)
        return [one for part, values in found for one in trial.measured(values, **part.factors)]


class Shot(NamedTuple):
    """An image as it is sent.

    Attributes:
        fields: Of its message, without ``data``.
        data: The field ``data``.
    """

    fields: dict[str, object]
    data: bytes


def parts(options: Options, setup: Condition) -> list[Part]:
    """Return what is measured in each run: the main condition, and with the first software further ones.

    PNG comes early: the converter's worker ends after 10 s without work, and the start of another one would
    count. The rate that the link cannot carry comes last: what is left of it in queues is sent for seconds.
    """
    found = [_part(MAIN_SIZE, RAW)]
    if setup.software != options.software[0]:
        return found
    if setup.system == "cloud":
        found.append(_part(MAIN_SIZE, PNG))
    if not options.quick:
        found += [_part(size, RAW) for size in SIZES if size != MAIN_SIZE]
        found.append(_part(MAIN_SIZE, RAW, mode=QUIET))
    found.append(_part(MAIN_SIZE, JPEG))
    if not options.quick:
        found.append(_part(MAIN_SIZE, RAW, is_above=True))
    return found


def _part(size: str, encoding: str, *, is_above: bool = False, mode: str = PRINTED) -> Part:
    factors = {
        "size": size,
        "encoding": encoding,
        "rate": "above" if is_above else "carried",
        "printed": "yes" if mode == PRINTED else "no",
    }
    rate = ABOVE_HZ if is_above else CARRIED_HZ[size]
    return Part(factors, mode, rate, stream=f"{encoding} {size}", is_whole=not is_above)


def write_images(listing: Path, encodings: list[str], sizes: list[str]) -> None:
    """Write images for a camera beside the file that lists them."""
    lines = []
    for size in sizes:
        pictures = [picture(*SIZES[size], number) for number in range(SHOTS)]
        for encoding in encodings:
            topic, kind = TOPICS[encoding]
            for number, pixels in enumerate(pictures):
                shot = shot_of(pixels, encoding)
                file = f"{encoding}-{size}-{number}.data"
                (listing.parent / file).write_bytes(shot.data)
                line = {"stream": f"{encoding} {size}", "topic": topic, "type": kind}
                lines.append(json.dumps(line | {"fields": shot.fields, "file": file}))
    listing.write_text("\n".join(lines) + "\n")


def picture(width: int, height: int, number: int) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
    """Return a picture of a floor, a wall and boxes, with a camera's noise; shape (height, width, 3)."""
    random = np.random.default_rng(number)
    down = np.linspace(0.0, 1.0, height)[:, None, None]
    pixels = np.where(down < 0.5, (180.0, 190.0, 200.0), (120.0, 100.0, 80.0)) * (0.6 + 0.4 * down)  # noqa: PLR2004
    pixels = np.broadcast_to(pixels, (height, width, 3)).copy()
    for _ in range(8):
        row, column = random.uniform(0.2, 0.8) * height, random.uniform(0.0, 0.9) * width
        rows = slice(int(row), int(row + height * random.uniform(0.05, 0.2)))
        columns = slice(int(column), int(column + width * random.uniform(0.05, 0.1)))
        pixels[rows, columns] = random.uniform(0.0, 255.0, 3)
    noisy = pixels + random.normal(0.0, NOISE, pixels.shape)
    return np.clip(noisy, 0, 255).astype(np.uint8)


def shot_of(pixels: np.ndarray[tuple[int, ...], np.dtype[np.uint8]], encoding: str) -> Shot:
    """Return a picture as it is sent: raw, or as JPEG."""
    height, width, _ = pixels.shape
    if encoding == JPEG:
        file = io.BytesIO()
        Image.fromarray(pixels).save(file, "JPEG", quality=QUALITY)
        return Shot({"format": "jpeg"}, file.getvalue())
    fields = {"height": height, "width": width, "encoding": "rgb8", "step": 3 * width}
    return Shot(fields, pixels.tobytes())
