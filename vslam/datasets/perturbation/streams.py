"""Random numbers by time: endless walks that do not depend on the order of reads."""

from __future__ import annotations

import threading
from array import array
from collections.abc import Iterable, Iterator
from itertools import count, islice
from math import exp, floor, inf

import numpy as np

STEP_S = 0.01
_TIME_CONSTANT_S = 2.0
_JUMPS_PER_S = 3.0 / 60.0
_JUMP_WIDENING = 1.5


def ou_walk(
    deviation: float, rng: np.random.Generator, jumps: Iterable[float] = ()
) -> Iterator[float]:
    """An endless Ornstein-Uhlenbeck walk with a time constant of 2 s, exact on a grid of 10 ms.

    Args:
        deviation: stationary standard deviation; the walk begins in the stationary state.
        rng: generates its normal numbers, one for each step.
        jumps: increasing times in seconds at which the walk is redrawn with 1.5 times the
            deviation.
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


class Drawn:
    """Random numbers by their position in a stream, drawn on first use; thread-safe."""

    def __init__(self, numbers: Iterator[float]) -> None:
        self._numbers = numbers
        self._drawn = array("d")
        self._lock = threading.Lock()

    def __getitem__(self, k: int) -> float:
        with self._lock:
            self._drawn.extend(islice(self._numbers, max(0, k + 1 - len(self._drawn))))
            return self._drawn[k]


def on_grid(t: float) -> int:
    """The step of a walk at time t."""
    # The small offset prevents a time on the grid from rounding into the previous step.
    return floor(t / STEP_S + 1e-6)


def jump_times(rng: np.random.Generator, per_second: float = _JUMPS_PER_S) -> Iterator[float]:
    """Endless times of a Poisson process, in seconds."""
    time = 0.0
    while True:
        time += rng.exponential(1.0 / per_second)
        yield time
