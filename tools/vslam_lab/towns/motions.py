"""Routes of a camera that moves in six degrees of freedom: through rooms, halls and above a town.

The position is a sum of sines, and so are yaw, pitch and roll. Their rates differ between seeds, so
each seed is another path.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from vslam.types.camera import Camera
from vslam_lab.towns.routes import Route, built_in_route
from vslam_lab.towns.terrain import Terrain, roads_of

Float = NDArray[np.float64]
Sine = tuple[float, float]  # amplitude in m or rad, and period in s

RATE = 20.0  # frames per second, as EuRoC
_WIDTH, _HEIGHT, _FOCAL = 512, 384, 320.0  # px; a field of view of 77 degrees
_START_S = 1.0  # in which a camera gets from rest to its speed
_VARIED = 0.15  # share by which periods differ between seeds


@dataclass(frozen=True)
class _Motion:
    """A motion about a place, or along a street.

    Attributes:
        about: description in a few words.
        land: ``room``, ``hall`` or ``town``.
        baseline: of the stereo pair, in metres.
        seconds: length of the drive.
        rest: seconds at the beginning in which the camera stands still.
        centre: mean position in metres. Along a street, x is the offset from the lane.
        shift: sines of x, y and z.
        yaw, pitch, roll: sines of the angles.
        down: mean angle in degrees by which the camera looks down.
        turning: mean yaw rate in rad/s.
        street: name of the built-in route along whose street the camera moves; empty for none.
        speed: along the street, in m/s.
    """

    about: str
    land: str
    baseline: float
    seconds: float
    rest: float
    centre: tuple[float, float, float]
    shift: tuple[tuple[Sine, ...], tuple[Sine, ...], tuple[Sine, ...]]
    yaw: tuple[Sine, ...]
    pitch: tuple[Sine, ...]
    roll: tuple[Sine, ...]
    down: float = 0.0
    turning: float = 0.0
    street: str = ""
    speed: float = 0.0


# A hand trembles at a few hertz. The steps of a walk come twice a second.
_HAND = ((0.003, 0.71), (0.0006, 0.23))
_HAND_TURN = ((0.006, 0.47), (0.002, 0.21))
_MOTIONS = {
    "room": _Motion(
        "a camera in the hand, in a furnished room", "room", 0.11, 24.0, 0.0, (0.0, -1.5, 0.0),
        (((1.0, 9.0), (0.12, 2.3), *_HAND), ((0.18, 4.1), *_HAND),
         ((0.8, 7.0), (0.1, 1.9), *_HAND)),
        ((0.5, 6.3), *_HAND_TURN), ((0.22, 5.1), *_HAND_TURN), ((0.14, 3.7), *_HAND_TURN),
        down=4.0, turning=0.3,
    ),
    "hall": _Motion(
        "a flight through a hall of 24 m, which starts at rest", "hall", 0.16, 30.0, 2.0,
        (0.0, -2.4, 0.0),
        (((2.6, 10.0), (0.2, 2.1)), ((0.9, 6.7), (0.08, 1.7)), ((6.0, 15.0), (0.25, 2.7))),
        ((0.6, 8.1), (0.08, 1.3)), ((0.12, 4.3), (0.03, 0.9)), ((0.16, 3.9), (0.04, 1.1)),
        down=5.0, turning=0.25,
    ),
    "walk": _Motion(
        "a camera in the hand of someone who walks through a street", "town", 0.2, 30.0, 0.0,
        (0.0, -1.6, 0.0),
        (((0.15, 5.0), (0.02, 1.0), *_HAND), ((0.025, 0.5), *_HAND), ((0.03, 0.5), *_HAND)),
        ((0.35, 7.0), (0.03, 1.0), *_HAND_TURN), ((0.1, 4.6), *_HAND_TURN),
        ((0.06, 3.3), *_HAND_TURN), street="block", speed=1.4,
    ),
    "drone": _Motion(
        "a drone above a town, which looks down and starts at rest", "town", 0.5, 40.0, 2.0,
        (0.0, -24.0, 0.0),
        (((3.0, 11.0), (0.3, 2.3)), ((2.5, 13.0), (0.1, 1.9)), ((0.5, 3.1),)),
        ((0.5, 9.0), (0.05, 1.3)), ((0.12, 5.3), (0.03, 0.9)), ((0.16, 4.1), (0.04, 1.1)),
        down=40.0, street="block", speed=5.0,
    ),
}  # fmt: skip

MOTIONS = {name: motion.about for name, motion in _MOTIONS.items()}


def built_in_motion(name: str, seed: int) -> Route:
    """Make one of `MOTIONS`. The seed determines the path.

    Raises:
        KeyError: the name is unknown.
    """
    plan = _MOTIONS[name]
    rng = np.random.default_rng([seed, sum(map(ord, name))])
    t = _since_start(np.arange(round(plan.seconds * RATE)) / RATE, plan.rest)
    x, y, z = (_sines(rng, parts, t) for parts in plan.shift)
    yaw, pitch, roll = (_sines(rng, parts, t) for parts in (plan.yaw, plan.pitch, plan.roll))
    yaw = yaw + plan.turning * t * rng.choice([-1.0, 1.0])
    at, heading = np.zeros((len(t), 3)), np.zeros(len(t))
    if plan.street:
        street = built_in_route(plan.street)
        roads, terrain = street.roads, street.terrain
        at, heading = _along(street, plan.speed * t)
    else:
        roads, terrain = roads_of([np.arange(-1.0, 1.0, 0.25)[:, None] * [0.0, 1.0]]), _flat()
    pitch = pitch - np.radians(plan.down)
    turns = Rotation.from_euler("YXZ", np.column_stack([heading + yaw, pitch, roll]))
    sideways, ahead = np.cos(heading), np.sin(heading)
    shift = np.column_stack([x * sideways + z * ahead, y, z * sideways - x * ahead])
    T_wc = np.tile(np.eye(4), (len(t), 1, 1))
    T_wc[:, :3, :3] = turns.as_matrix()
    T_wc[:, :3, 3] = at + plan.centre + shift
    centre = (_WIDTH - 1) / 2, (_HEIGHT - 1) / 2
    camera = Camera(_FOCAL, _FOCAL, *centre, plan.baseline, _WIDTH, _HEIGHT)
    return Route(name, plan.about, plan.land, camera, T_wc, roads, terrain, RATE, free=True)


def _since_start(t: Float, rest: float) -> Float:
    """Return the time on the path: it stands still for ``rest`` seconds, and then starts softly."""
    if rest == 0.0:
        return t
    s = np.clip((t - rest) / _START_S, 0.0, 1.0)
    # The integral of the smooth step 6 s^5 - 15 s^4 + 10 s^3, from which acceleration and jerk are
    # continuous.
    started = _START_S * (s**6 - 3.0 * s**5 + 2.5 * s**4)
    return np.asarray(started + np.maximum(t - rest - _START_S, 0.0))


def _sines(rng: np.random.Generator, parts: tuple[Sine, ...], t: Float) -> Float:
    total = np.zeros_like(t)
    for size, period in parts:
        phase = rng.uniform(0.0, 2.0 * np.pi)
        rate = 2.0 * np.pi / (period * rng.uniform(1.0 - _VARIED, 1.0 + _VARIED))
        total += size * np.sin(rate * t + phase)
    return total


def _along(street: Route, metres: Float) -> tuple[Float, Float]:
    """Return the ``(N, 3)`` points of the street, with y down, and the ``(N,)`` headings."""
    from scipy.interpolate import make_splrep

    xz = street.T_wc[:, [0, 2], 3]
    along = np.cumsum(np.r_[0.0, np.linalg.norm(np.diff(xz, axis=0), axis=1)])
    # The poses of a car are connected straight. A path without corners has finite accelerations.
    path = [make_splrep(along, line, k=5, s=0.0025 * len(along)) for line in xz.T]
    at = np.column_stack([line(metres) for line in path])
    step = np.column_stack([line(metres, 1) for line in path])
    heading = np.unwrap(np.arctan2(step[:, 0], step[:, 1]))
    return np.column_stack([at[:, 0], np.zeros(len(at)), at[:, 1]]), heading


def _flat() -> Terrain:
    return Terrain(np.array([-50.0, -50.0]), 100.0, np.zeros((2, 2)))
