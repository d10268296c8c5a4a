"""Perturbations that are caused by the sensor, by compression or by transmission."""

from __future__ import annotations

import numpy as np

from vslam.datasets.perturbation.kinds import Law, LawKind, RandomStream, to_8_bits
from vslam.support.errors import DroppedFrameError
from vslam.types.camera import Image


def _noise(strength: float, stream: RandomStream) -> Law:
    def law(frame: int, t: float, side: int, image: Image) -> Image:
        rng = np.random.Generator(np.random.SFC64([*stream, frame, side]))
        grain = rng.standard_normal(image.shape, dtype=np.float32)
        return to_8_bits(image + 8.0 * strength * grain)

    return law


def _shot(photons: float, stream: RandomStream) -> Law:
    def law(frame: int, t: float, side: int, image: Image) -> Image:
        rng = np.random.Generator(np.random.SFC64([*stream, frame, side]))
        counts = rng.poisson(np.arange(256) * (photons / 255.0), (1024, 256)).astype(np.float32)
        # Choosing from a table of draws for each grey value is eight times faster than drawing a
        # Poisson number for each pixel.
        row = rng.integers(0, len(counts), image.shape, dtype=np.int32)
        return to_8_bits(counts[row, image] * np.float32(255.0 / photons))

    return law


def _impulse(percent: float, stream: RandomStream) -> Law:
    def law(frame: int, t: float, side: int, image: Image) -> Image:
        rng = np.random.Generator(np.random.SFC64([*stream, frame, side]))
        number = rng.random(image.shape, dtype=np.float32)
        changed = number < percent / 100.0
        white = number < percent / 200.0
        return np.where(changed, np.where(white, np.uint8(255), np.uint8(0)), image)

    return law


def _bits(bits: float, stream: RandomStream) -> Law:
    step = 2.0 ** (8.0 - bits)

    def law(frame: int, t: float, side: int, image: Image) -> Image:
        return image if step == 1.0 else to_8_bits(np.floor(image / step) * step)

    return law


def _jpeg(quality: float, stream: RandomStream) -> Law:
    def law(frame: int, t: float, side: int, image: Image) -> Image:
        import cv2

        data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, round(quality)])[1]
        return np.asarray(cv2.imdecode(data, cv2.IMREAD_GRAYSCALE), np.uint8)

    return law


def _resolution(share: float, stream: RandomStream) -> Law:
    def law(frame: int, t: float, side: int, image: Image) -> Image:
        import cv2

        height, width = image.shape
        size = max(1, round(share * width)), max(1, round(share * height))
        if size == (width, height):
            return image
        small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        return np.asarray(cv2.resize(small, (width, height)), np.uint8)

    return law


def _drop(percent: float, stream: RandomStream) -> Law:
    def law(frame: int, t: float, side: int, image: Image) -> Image:
        if frame and np.random.default_rng([*stream, frame]).uniform() < percent / 100.0:
            raise DroppedFrameError(frame)
        return image

    return law


def _outage(seconds: float, stream: RandomStream) -> Law:
    """Drop all frames during one outage in every ten seconds. None begins in the first second."""

    def law(frame: int, t: float, side: int, image: Image) -> Image:
        block = int(t // 10.0)
        first = max(1.0, 10.0 * block)
        begin = np.random.default_rng([*stream, block]).uniform(
            first, max(first, 10.0 * (block + 1) - seconds)
        )
        if begin <= t < begin + seconds:
            raise DroppedFrameError(frame)
        return image

    return law


KINDS = {
    "noise": LawKind(
        _noise, "x", 1.0, 0.1, 15.0, "Gaussian noise of 8 grey levels", most=15.0, logarithmic=True
    ),
    "shot": LawKind(
        _shot, "photons", 25.0, 10_000.0, 0.5, "photons that a white pixel receives",
        least=0.1, most=1e5, logarithmic=True,
    ),
    "impulse": LawKind(_impulse, "%", 5.0, 0.0, 50.0, "pixels turned black or white", most=100.0),
    "bits": LawKind(
        _bits, "bits", 3.0, 8.0, 1.0, "bits of a grey value", least=1.0, most=8.0, drawn=False
    ),
    "jpeg": LawKind(
        _jpeg, "quality", 10.0, 100.0, 1.0, "JPEG compression", least=1.0, most=100.0,
        logarithmic=True, drawn=False,
    ),
    "resolution": LawKind(
        _resolution, "of 1", 0.3, 1.0, 0.02, "share of the width that remains",
        least=0.01, most=1.0, logarithmic=True, drawn=False,
    ),
    "drop": LawKind(_drop, "%", 30.0, 0.0, 95.0, "frames dropped at random", most=99.0),
    "outage": LawKind(
        _outage, "s", 1.0, 0.1, 9.0, "length of a gap in every ten seconds", most=9.0,
        logarithmic=True,
    ),
}  # fmt: skip
