"""Perturbations of the light, and of the camera's response to light.

The random processes are defined for all times. They do not depend on the order in which frames are
read.
"""

from __future__ import annotations

import threading
from array import array
from collections.abc import Callable, Iterable, Iterator
from itertools import count, islice
from math import exp, floor, inf

import numpy as np
from numpy.typing import NDArray

from vslam.datasets.perturbation.kinds import Law, LawKind, RandomStream, to_8_bits
from vslam.types.camera import Image

STEP_S = 0.01
_TIME_CONSTANT_S = 2.0
_JUMPS_PER_S = 3.0 / 60.0
_JUMP_WIDENING = 1.5
_GREYS = np.arange(256, dtype=np.float64)

FULL_WELL = 10_000.0  # electrons at grey value 255, as in a Sony ICX267
READ_NOISE = 10.0  # electrons, typical for such sensors
_TUNNEL_STOPS = 3.0
_TUNNELS_PER_S = 1.0 / 5.0
# Gain and gamma at each level of ``dark``. Each level lowers one of them.
DARK_GAIN = tuple(1.0 - 0.15 * ((level + 1) // 2) for level in range(13))
DARK_GAMMA = tuple(1.0 - 0.1 * (level // 2) for level in range(13))
_BLACKOUTS = ((0.16, 0.64), (0.32, 0.40))  # seconds without light, and seconds of increasing light
_LIT_S = 1.0  # time before the first blackout may begin


def ou_walk(
    deviation: float, rng: np.random.Generator, jumps: Iterable[float] = ()
) -> Iterator[float]:
    """Yield the values of an Ornstein-Uhlenbeck process with a time constant of 2 s, without end.

    Consecutive values are 10 ms apart. The process begins in the stationary state.

    Args:
        deviation: stationary standard deviation.
        jumps: increasing times in seconds. At each of these times, the value is drawn anew, from a
            normal distribution with 1.5 times the deviation.
    """
    decay = exp(-STEP_S / _TIME_CONSTANT_S)
    spread = (1.0 - decay**2) ** 0.5
    steps = (round(time / STEP_S) for time in jumps)
    jump = next(steps, inf)
    x = rng.standard_normal()
    yield deviation * x
    for k in count(1):
        noise = rng.standard_normal()
        x = _JUMP_WIDENING * noise if k == jump else decay * x + spread * noise
        while jump <= k:
            jump = next(steps, inf)
        yield deviation * x


class Cached:
    """Gives access by index to the numbers that an endless iterator yields. It is thread-safe."""

    def __init__(self, numbers: Iterator[float]) -> None:
        self._numbers = numbers
        self._known = array("d")
        self._lock = threading.Lock()

    def __getitem__(self, k: int) -> float:
        with self._lock:
            self._known.extend(islice(self._numbers, max(0, k + 1 - len(self._known))))
            return self._known[k]


def on_grid(t: float) -> int:
    """Return the index of the value of a random process at time t (seconds)."""
    # Without the small offset, rounding errors could move a time on the grid to the previous step.
    return floor(t / STEP_S + 1e-6)


def jump_times(rng: np.random.Generator, per_second: float = _JUMPS_PER_S) -> Iterator[float]:
    """Yield the times in seconds of the events of a Poisson process, without end."""
    time = 0.0
    while True:
        time += rng.exponential(1.0 / per_second)
        yield time


def _pointwise(curve: Callable[[int, float], NDArray[np.float64]]) -> Law:
    """Make a perturbation from a function that returns ``(256,)`` new grey values for a frame."""

    def law(frame: int, t: float, side: int, image: Image) -> Image:
        import cv2

        table = np.clip(np.rint(curve(frame, t)), 0, 255).astype(np.uint8)
        return np.asarray(cv2.LUT(image, table), np.uint8)

    return law


def _brightness(strength: float, stream: RandomStream) -> Law:
    rng_gain, rng_bias = (np.random.default_rng([*stream, k]) for k in range(2))

    def jumps() -> Iterator[float]:
        return jump_times(np.random.default_rng([*stream, 2]))

    log_gain = Cached(ou_walk(0.35 * strength, rng_gain, jumps()))
    bias = Cached(ou_walk(20.0 * strength, rng_bias, jumps()))
    limit = max(1.0, strength)

    def curve(frame: int, t: float) -> NDArray[np.float64]:
        at = on_grid(t)
        return np.exp(np.clip(log_gain[at], -1.2 * limit, 0.7 * limit)) * _GREYS + bias[at]

    return _pointwise(curve)


def _gamma(strength: float, stream: RandomStream) -> Law:
    log_gamma = Cached(ou_walk(0.35 * strength, np.random.default_rng(stream)))
    return _pointwise(lambda frame, t: 255.0 * (_GREYS / 255.0) ** np.exp(log_gamma[on_grid(t)]))


def _flicker(strength: float, stream: RandomStream) -> Law:
    numbers = Cached(iter(np.random.default_rng(stream).standard_normal, None))
    return _pointwise(lambda frame, t: np.exp(0.15 * strength * numbers[frame]) * _GREYS)


def _exposure(seconds: float, stream: RandomStream) -> Law:
    """Lower and raise the light by 3 stops in turn. The auto-exposure follows with a delay."""

    def errors() -> Iterator[float]:
        rng = np.random.default_rng(stream)
        steps = (round(time / STEP_S) for time in jump_times(rng, _TUNNELS_PER_S))
        follow = 1.0 if seconds == 0 else 1.0 - exp(-STEP_S / seconds)
        k, light, metered, jump = 0, 0.0, 0.0, next(steps)
        while True:
            yield light - metered
            k += 1
            while jump <= k:
                light, jump = -_TUNNEL_STOPS - light, next(steps)
            metered += follow * (light - metered)

    stops = Cached(errors())
    return _pointwise(lambda frame, t: _GREYS * 2.0 ** stops[on_grid(t)])


def _night(stops: float, stream: RandomStream) -> Law:
    """Reduce the light at unchanged exposure and gain. Noise is computed in electrons."""
    electrons = FULL_WELL / 255.0

    def law(frame: int, t: float, side: int, image: Image) -> Image:
        if stops == 0:
            return image
        rng = np.random.Generator(np.random.SFC64([*stream, frame, side]))
        mean = image * np.float32(electrons * 2.0**-stops)
        # Because read noise is added, a normal distribution approximates the Poisson noise well.
        noise = rng.standard_normal(image.shape, dtype=np.float32)
        counted = mean + noise * np.sqrt(mean + np.float32(READ_NOISE**2))
        return to_8_bits(counted / np.float32(electrons))

    return law


def _dark(level: float, stream: RandomStream) -> Law:
    gain, gamma = (np.interp(level, range(13), values) for values in (DARK_GAIN, DARK_GAMMA))
    darkened = 255.0 * gain * (_GREYS / 255.0) ** (1.0 / gamma)
    return _pointwise(lambda frame, t: darkened)


def _blackout(period: float, stream: RandomStream) -> Law:
    """Switch the light off once in every period, at a random time, as ``_BLACKOUTS`` says."""

    def curve(frame: int, t: float) -> NDArray[np.float64]:
        if t < _LIT_S:
            return _GREYS
        k, since = divmod(t - _LIT_S, period)
        black, dim = _BLACKOUTS[int(k) % len(_BLACKOUTS)]
        since -= np.random.default_rng([*stream, int(k)]).uniform(0.0, period - black - dim)
        return _GREYS if since < 0.0 else _GREYS * min(max(0.0, since - black) / dim, 1.0)

    return _pointwise(curve)


def _bias(greys: float, stream: RandomStream) -> Law:
    return _pointwise(lambda frame, t: _GREYS + greys)


def _contrast(percent: float, stream: RandomStream) -> Law:
    def law(frame: int, t: float, side: int, image: Image) -> Image:
        import cv2

        mean = float(image.mean())
        table = to_8_bits(mean + percent / 100.0 * (_GREYS - mean))
        return np.asarray(cv2.LUT(image, table), np.uint8)

    return law


KINDS = {
    "brightness": LawKind(
        _brightness, "x", 1.0, 0.1, 10.0, "gain and offset drift and jump at random",
        logarithmic=True,
    ),
    "gamma": LawKind(_gamma, "x", 1.0, 0.1, 10.0, "gamma drifts at random", logarithmic=True),
    "flicker": LawKind(
        _flicker, "x", 1.0, 0.1, 10.0, "a random gain for each frame", logarithmic=True
    ),
    "exposure": LawKind(
        _exposure, "s", 0.5, 0.02, 10.0, "auto-exposure lags behind light changes of 3 stops",
        logarithmic=True,
    ),
    "night": LawKind(
        _night, "stops", 4.0, 0.0, 10.0, "less light, shot and read noise", most=16.0
    ),
    "dark": LawKind(
        _dark, "level", 6.0, 0.0, 12.0, "maximum brightness and gamma lowered in turn", most=12.0,
        drawn=False,
    ),
    "blackout": LawKind(
        _blackout, "s", 5.0, 60.0, 1.0, "period in which the light goes out once",
        least=1.0, most=3600.0, logarithmic=True,
    ),
    "bias": LawKind(
        _bias, "grey levels", 50.0, 0.0, 255.0, "grey levels added to every pixel",
        least=-255.0, most=255.0, drawn=False,
    ),
    "contrast": LawKind(
        _contrast, "%", 30.0, 100.0, 1.0, "share of the contrast that remains", most=100.0,
        logarithmic=True, drawn=False,
    ),
}  # fmt: skip
