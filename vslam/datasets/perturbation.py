"""Seeded photometric perturbations of a stereo sequence (docs/design.md, section 10).

With v a grey value, s the strength (1 unless ``law:s`` says otherwise), t seconds since the first
frame, k the frame and n a standard normal number:

==========  ======================================================================================
brightness  v exp(g(t)) + b(t): g and b are Ornstein-Uhlenbeck walks, time constant 2 s, deviations
            0.35 s and 20 s grey levels. Three times a minute on average both jump (tunnel,
            auto-exposure): they are drawn anew, 1.5 times as wide. g is clipped to
            [-1.2, 0.7] max(1, s).
gamma       255 (v / 255)^exp(g(t)): g is such a walk of deviation 0.35 s, without jumps.
flicker     v exp(0.15 s n_k): one n for each frame, as under mains lighting.
noise       v + 8 s n: one n for each pixel, frame and camera.
blur        Gaussian blur of deviation 1.5 s pixels.
occlusion   a grey rectangle, as of dirt on the glass, over min(0.15 s, 0.9) of the image's area;
            place, shape and grey value are drawn anew every second.
==========  ======================================================================================

Each law rounds and clips to 8 bits, is the same for both cameras (noise alone is drawn for each)
and draws from its own random stream: it does the same alone and in company, and what it does to
frame k depends on the seed, k and the time of k only, not on the frames asked for before. Laws of
other packages (docs/plugins.md) are held to that, too.
Walks live on a fixed grid in time, so that dropping frames does not change the light. They are
drawn as far as frames have come: a stream may go on without end.
"""

from __future__ import annotations

import threading
from array import array
from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from itertools import count, islice
from math import exp, floor, inf, isfinite
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from vslam.camera import DepthImage, Image, ImageMap
from vslam.datasets.plugin_laws import plugin_laws
from vslam.datasets.sequence import Sequence
from vslam.datasets.stream import TimedFrame
from vslam.errors import InputError

Law = Callable[[int, float, int, Image], Image]
"""``(frame, t, side, image) -> image`` of the same shape; t is in seconds since the first frame,
side 0 is left, 1 is right."""

_STEP_S = 0.01
_TIME_CONSTANT_S = 2.0
_JUMPS_PER_S = 3.0 / 60.0
_JUMP_WIDENING = 1.5
_MAX_STRENGTH = 10.0
_GREYS = np.arange(256, dtype=np.float64)


@dataclass(frozen=True)
class Perturbation:
    """Laws applied one after the other; without any, the images pass unchanged.

    Attributes:
        name: canonical spelling, ``none`` or ``brightness:1.5,blur:0.5`` for example.
        laws: see the module.
    """

    name: str
    laws: tuple[Law, ...] = ()

    def apply(
        self, index: int, t: float, left: Image, second: Image | DepthImage | None
    ) -> tuple[Image, Image | DepthImage | None]:
        """Perturb both ``(H, W)`` uint8 images of frame ``index``, ``t`` seconds after the first
        one; safe in several threads. A depth image stays as it is: it has its own light.

        The left one becomes the same whatever the second one is.
        """
        for law in self.laws:
            left = law(index, t, 0, left)
            if second is not None and second.dtype == np.uint8:
                second = law(index, t, 1, np.asarray(second, np.uint8))
        return left, second


def parse_perturbation(spec: str, seed: int) -> Perturbation:
    """Build the perturbation that ``--perturb`` names.

    Args:
        spec: ``law[:strength]``, several joined by commas, applied in this order; ``none`` or
            nothing for the identity.
        seed: not negative; equal seeds give equal images.

    Raises:
        InputError: unknown or repeated law, strength no number or not within 0 to 10, a negative
            seed, or a broken package.
    """
    if seed < 0:
        raise InputError(f"--seed {seed}: must not be negative.")
    if spec.strip() in ("", "none"):
        return Perturbation("none")
    strengths: dict[str, float] = {}
    makers = {**_MAKERS, **plugin_laws(), **_MAKERS}  # vslam's own names come first and win
    for item in spec.split(","):
        law, _, strength = item.strip().partition(":")
        if law not in makers:
            raise InputError(
                f"--perturb {spec}: unknown law '{law}'; choose from none, {', '.join(makers)}."
            )
        if law in strengths:
            raise InputError(f"--perturb {spec}: {law} is given twice; add up its strengths.")
        strengths[law] = _parse_strength(spec, strength) if ":" in item else 1.0
    return Perturbation(
        ",".join(f"{law}:{strength:g}" for law, strength in strengths.items()),
        tuple(
            makers[law](strength, (seed, crc32(law.encode())))
            for law, strength in strengths.items()
        ),
    )


def perturbed(frames: Iterator[TimedFrame], perturbation: Perturbation) -> Iterator[TimedFrame]:
    """The same frames, perturbed as they are read; the first one's time is 0 to the laws."""
    begin = None
    for index, frame in enumerate(frames):
        begin = frame.timestamp if begin is None else begin
        t = frame.timestamp - begin
        yield TimedFrame(frame.timestamp, partial(_read_perturbed, frame, perturbation, index, t))


def _read_perturbed(
    frame: TimedFrame, perturbation: Perturbation, index: int, t: float, image_map: ImageMap
) -> tuple[Image, Image | DepthImage | None]:
    return perturbation.apply(index, t, *frame.read(image_map))


def contact_sheet(
    sequence: Sequence, perturbation: Perturbation, indices: Collection[int]
) -> Image:
    """A grey image with a row for each frame: left image as it is, both images perturbed.

    Raises:
        UnreadableImageError: one of the frames cannot be read.
    """
    import cv2

    rows = []
    for index in indices:
        t = float(sequence.timestamps[index] - sequence.timestamps[0])
        left, second = sequence.read(index)
        width = 480
        height = round(width * left.shape[0] / left.shape[1])
        row = np.hstack(
            [
                cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
                for image in (left, *perturbation.apply(index, t, left, second))
                if image is not None and image.dtype == np.uint8
            ]
        )
        label = f"frame {index}, {sequence.timestamps[index]:.1f} s"
        row[:20, :150] = 0
        cv2.putText(row, label, (6, 15), cv2.FONT_HERSHEY_SIMPLEX, 0.45, 255, 1)
        rows.append(row)
    return np.vstack(rows)


def ou_walk(
    deviation: float, rng: np.random.Generator, jumps: Iterable[float] = ()
) -> Iterator[float]:
    """An Ornstein-Uhlenbeck walk of time constant 2 s, exact on a grid of 10 ms, without end.

    Args:
        deviation: stationary standard deviation; the walk begins in the stationary state.
        rng: source of its normal numbers, one for each step.
        jumps: times in seconds, increasing, at which the walk is drawn anew, 1.5 times as wide.
    """
    decay = exp(-_STEP_S / _TIME_CONSTANT_S)
    spread = (1.0 - decay**2) ** 0.5
    steps = (round(time / _STEP_S) for time in jumps)
    jump = next(steps, inf)
    x = rng.standard_normal()
    yield deviation * x
    for k in count(1):
        noise = rng.standard_normal()
        x = _JUMP_WIDENING * noise if k == jump else decay * x + spread * noise
        while jump <= k:
            jump = next(steps, inf)
        yield deviation * x


def _parse_strength(spec: str, text: str) -> float:
    try:
        strength = float(text)
    except ValueError:
        strength = inf
    if not (isfinite(strength) and 0.0 <= strength <= _MAX_STRENGTH):
        raise InputError(
            f"--perturb {spec}: bad strength '{text}'; give a number from 0 to "
            f"{_MAX_STRENGTH:g}, 1 is the default."
        )
    return strength


class _Drawn:
    """Random numbers by their place in a stream, drawn up to the last one asked for; safe in
    several threads."""

    def __init__(self, numbers: Iterator[float]) -> None:
        self._numbers = numbers
        self._drawn = array("d")
        self._lock = threading.Lock()

    def __getitem__(self, k: int) -> float:
        with self._lock:
            self._drawn.extend(islice(self._numbers, max(0, k + 1 - len(self._drawn))))
            return self._drawn[k]


def _on_grid(t: float) -> int:
    # The small offset keeps a time that lies on the grid from rounding into the cell before it.
    return floor(t / _STEP_S + 1e-6)


def _jump_times(rng: np.random.Generator) -> Iterator[float]:
    time = 0.0
    while True:
        time += rng.exponential(1.0 / _JUMPS_PER_S)
        yield time


def _pointwise(curve: Callable[[int, float], NDArray[np.float64]]) -> Law:
    """A law that sends grey value v of frame k at time t to ``curve(k, t)[v]``."""

    def law(frame: int, t: float, side: int, image: Image) -> Image:
        import cv2

        table = np.clip(np.rint(curve(frame, t)), 0, 255).astype(np.uint8)
        return np.asarray(cv2.LUT(image, table), np.uint8)

    return law


def _brightness(strength: float, stream: tuple[int, int]) -> Law:
    rng_gain, rng_bias = (np.random.default_rng([*stream, k]) for k in range(2))

    def jumps() -> Iterator[float]:
        return _jump_times(np.random.default_rng([*stream, 2]))

    log_gain = _Drawn(ou_walk(0.35 * strength, rng_gain, jumps()))
    bias = _Drawn(ou_walk(20.0 * strength, rng_bias, jumps()))
    limit = max(1.0, strength)

    def curve(frame: int, t: float) -> NDArray[np.float64]:
        at = _on_grid(t)
        return np.exp(np.clip(log_gain[at], -1.2 * limit, 0.7 * limit)) * _GREYS + bias[at]

    return _pointwise(curve)


def _gamma(strength: float, stream: tuple[int, int]) -> Law:
    walk = _Drawn(ou_walk(0.35 * strength, np.random.default_rng(stream)))
    return _pointwise(lambda frame, t: 255.0 * (_GREYS / 255.0) ** np.exp(walk[_on_grid(t)]))


def _flicker(strength: float, stream: tuple[int, int]) -> Law:
    numbers = _Drawn(iter(np.random.default_rng(stream).standard_normal, None))
    return _pointwise(lambda frame, t: np.exp(0.15 * strength * numbers[frame]) * _GREYS)


def _noise(strength: float, stream: tuple[int, int]) -> Law:
    def law(frame: int, t: float, side: int, image: Image) -> Image:
        rng = np.random.Generator(np.random.SFC64([*stream, frame, side]))
        grain = rng.standard_normal(image.shape, dtype=np.float32)
        return np.clip(np.rint(image + 8.0 * strength * grain), 0, 255).astype(np.uint8)

    return law


def _blur(strength: float, stream: tuple[int, int]) -> Law:
    def law(frame: int, t: float, side: int, image: Image) -> Image:
        import cv2

        if strength == 0:
            return image
        return np.asarray(cv2.GaussianBlur(image, (0, 0), 1.5 * strength), np.uint8)

    return law


def _occlusion(strength: float, stream: tuple[int, int]) -> Law:
    area = min(0.15 * strength, 0.9)

    def law(frame: int, t: float, side: int, image: Image) -> Image:
        rng = np.random.default_rng([*stream, int(t)])
        height, width = image.shape
        across = rng.uniform(area, 1.0)  # fraction of the width; the height follows from the area
        box_w, box_h = round(across * width), round(area / across * height)
        x, y = rng.integers(width - box_w + 1), rng.integers(height - box_h + 1)
        covered = image.copy()
        covered[y : y + box_h, x : x + box_w] = rng.integers(256)
        return covered

    return law


_MAKERS: dict[str, Callable[[float, tuple[int, int]], Law]] = {
    "brightness": _brightness,
    "gamma": _gamma,
    "flicker": _flicker,
    "noise": _noise,
    "blur": _blur,
    "occlusion": _occlusion,
}
