"""The routes of the camera: built-in routes, and routes along given poses."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vslam.support.errors import InputError, did_you_mean
from vslam.types.camera import Camera
from vslam_lab.towns.terrain import Roads, Terrain, roads_of

Float = NDArray[np.float64]

CAMERA_HEIGHT = 1.65  # m
RATE = 10.0  # frames per second
_MAX_STEP = 5.0  # m between frames
_LANE = 1.6  # m from the middle of the road to the middle of a lane
_CAMERAS = {  # as in KITTI's three recording periods
    "00-02": Camera(718.856, 718.856, 607.1928, 185.2157, 0.53716, 1241, 376),
    "03": Camera(721.5377, 721.5377, 609.5593, 172.854, 0.53715, 1242, 375),
    "04-12": Camera(707.0912, 707.0912, 601.8873, 183.1104, 0.53715, 1226, 370),
}

CALIBRATIONS = tuple(_CAMERAS)


@dataclass(frozen=True)
class Route:
    """The path of the camera in a town, with the roads and the terrain of the town.

    Attributes:
        name: name of the route, for example ``demo``.
        about: description in a few words.
        land: ``town``, ``suburb`` or ``motorway``; ``room`` or ``hall``, where roads and terrain
            are not used.
        camera: the stereo rig.
        T_wc: ``(N, 4, 4)`` float64 poses of the left camera in the world frame of the town. The
            heights of the terrain are measured from the plane y = 0 of this frame.
        rate: frames per second.
        free: whether the camera moves in six degrees of freedom, so that pitching blurs its images.
    """

    name: str
    about: str
    land: str
    camera: Camera
    T_wc: Float
    roads: Roads
    terrain: Terrain
    rate: float = RATE
    free: bool = False

    @property
    def timestamps(self) -> Float:
        return np.arange(len(self.T_wc)) / self.rate

    @property
    def yaw_rate(self) -> Float:
        """Yaw rate of the camera at each frame, ``(N,)`` float64 rad/s."""
        heading = np.unwrap(np.arctan2(self.T_wc[:, 0, 2], self.T_wc[:, 2, 2]))
        return np.asarray(np.gradient(heading) * self.rate)

    @property
    def pitch_rate(self) -> Float:
        """Pitch rate of the camera at each frame, ``(N,)`` float64 rad/s; 0 for a car."""
        if not self.free:
            return np.zeros(len(self.T_wc))
        rise = np.arcsin(np.clip(self.T_wc[:, 1, 2], -1.0, 1.0))
        return np.asarray(np.gradient(rise) * self.rate)

    @property
    def ground_truth(self) -> Float:
        """``(N, 4, 4)`` float64 ``T_wc`` of the left camera.

        As in KITTI, the world frame is that of the left camera at the first frame.
        """
        return np.asarray(np.linalg.inv(self.T_wc[0]) @ self.T_wc)


@dataclass(frozen=True)
class _Leg:
    """A path along corner points ``(x, z)`` in metres.

    ``lanes`` gives the lane after each corner: 1 for the right lane, -1 for the left lane.
    """

    corners: tuple[tuple[float, float], ...]
    lanes: tuple[float, ...] = ()
    radius: float = 11.0
    speed: float = 8.5  # m/s


@dataclass(frozen=True)
class _BuiltIn:
    about: str
    land: str
    camera: str
    leg: _Leg
    hills: float = 0.4  # m


def _winding() -> tuple[tuple[float, float], ...]:
    z = np.linspace(0, 560, 40)
    x = 45 * np.sin(z / 75) + 22 * np.sin(z / 41 + 1) + 0.1 * z
    return tuple(zip(x.tolist(), z.tolist(), strict=True))


def _bend() -> tuple[tuple[float, float], ...]:
    z = np.linspace(0, 1200, 30)
    return tuple(zip((150 * np.sin(z / 520)).tolist(), z.tolist(), strict=True))


_BUILT_IN = {
    "demo": _BuiltIn(
        "one loop around a block", "town", "00-02",
        _Leg(((0, 0), (0, 80), (62, 96), (84, 20), (0, -10), (0, 62)))),
    "00": _BuiltIn(
        "town; five revisits, one on the other lane, one in the opposite direction",
        "town",
        "00-02",
        _Leg(((0, 0), (0, 180), (120, 180), (120, 0), (-4, -18), (0, 60), (0, 180), (-110, 195),
              (-120, 70), (0, 62), (120, 70), (120, 180), (0, 180), (0, 62), (-120, 70),
              (-130, -40), (0, -40), (0, 100)),
             (1, 1, 1, 1, 1, -1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1))),
    "01": _BuiltIn("motorway at 25 m/s, sparse texture", "motorway", "00-02",
                   _Leg(_bend(), radius=180, speed=25.0), hills=3.0),
    "02": _BuiltIn(
        "long suburb with hills and two revisits", "suburb", "00-02",
        _Leg(((0, 0), (30, 150), (-20, 330), (140, 420), (260, 330), (220, 180), (300, 40),
              (160, -60), (0, -30), (30, 150), (-20, 330), (-180, 380), (-240, 220), (-130, 120),
              (0, 0), (160, -60), (230, -85)), radius=20.0), hills=7.0),
    "03": _BuiltIn("winding road", "suburb", "03", _Leg(_winding(), radius=25.0), hills=2.5),
    "04": _BuiltIn("straight road", "town", "04-12",
                   _Leg(((0, 0), (0, 200), (3, 400)), radius=200.0, speed=14.0)),
    "05": _BuiltIn(
        "town grid with four revisits", "town", "04-12",
        _Leg(((0, 0), (0, 180), (90, 180), (90, 90), (0, 90), (0, 180), (180, 180), (180, 0),
              (90, 0), (0, 0), (0, 90), (-80, 90), (-80, 0), (0, 0), (90, 0), (90, 160)))),
    "block": _BuiltIn(
        "short loop for tests of loop closing", "town", "00-02",
        _Leg(((0, 0), (0, 52), (46, 62), (56, 6), (0, -14), (0, 52)), speed=11.0)),
    "lane": _BuiltIn(
        "the same loop, revisited on the other lane", "town", "00-02",
        _Leg(((0, 0), (0, 52), (46, 62), (56, 6), (0, -14), (0, 52)), (1, 1, 1, 1, -1, -1),
             speed=11.0)),
}  # fmt: skip

ROUTES = {name: route.about for name, route in _BUILT_IN.items()}
# Names that stand for a route with a variation. datasets.md explains how the town was chosen.
DRIVES = {"night": "lane+change:1+seed:1"}


def built_in_route(name: str, others: Iterable[str] = ()) -> Route:
    """Make one of `ROUTES`.

    Args:
        others: further known names, for the error message.

    Raises:
        InputError: the name is unknown.
    """
    if name not in _BUILT_IN:
        known = (*ROUTES, *others, *DRIVES)
        raise InputError(
            f"synthetic route {name}: unknown{did_you_mean(name, known)}; choose one of "
            f"{', '.join(known)}."
        )
    plan = _BUILT_IN[name]
    leg = plan.leg
    middle, lane = _round_corners(leg)
    heading = _headings(middle)
    right = np.stack([np.cos(heading), -np.sin(heading)], axis=1)
    path = middle + right * (_LANE * lane)[:, None]
    xz = _drive(path, leg.speed)
    ahead = _straight(middle[-1], middle[-1] - middle[-8], np.linspace(0, 130, 200))
    behind = _straight(middle[0], middle[0] - middle[8], np.linspace(40, 0, 80))
    roads = roads_of([np.vstack([behind, middle, ahead])])
    seed = sum(map(ord, name))
    terrain = _terrain(roads.xz, lambda at: plan.hills * _waves(at, seed))
    camera = _CAMERAS[plan.camera]
    return Route(name, plan.about, plan.land, camera, _poses(xz, terrain), roads, terrain)


def _straight(start: Float, direction: Float, metres: Float) -> Float:
    """Return the ``(K, 2)`` points on a ray at the ``(K,)`` distances ``metres`` from its start."""
    return start + np.outer(metres, direction) / np.linalg.norm(direction)


def route_of_poses(T_wc: Float, name: str, calibration: str = "00-02") -> Route:
    """Make a route along given poses, for example along KITTI's ground truth.

    If the camera passes a place several times, its heights there are averaged, because a road has
    only one height. Headings, pitches and rolls are kept. ``Route.ground_truth`` contains the
    averaged heights.

    Args:
        T_wc: ``(N, 4, 4)`` float64 poses, with the y axis pointing down.
        calibration: one of `CALIBRATIONS`, which names the KITTI sequences whose camera is used.

    Raises:
        InputError: the calibration is unknown, a pose is not finite, the path has fewer than 20
            poses or is shorter than 20 m, or consecutive poses are more than 5 m apart.
    """
    if calibration not in CALIBRATIONS:
        raise InputError(
            f"--calibration {calibration}: unknown; choose one of {', '.join(CALIBRATIONS)}."
        )
    if not np.isfinite(T_wc).all():
        raise InputError(f"{name}: a pose contains NaN or infinity; repair the trajectory.")
    if len(T_wc) < 20:
        raise InputError(f"{name}: {len(T_wc)} poses; a trajectory needs at least 20.")
    steps = np.linalg.norm(np.diff(T_wc[:, :3, 3], axis=0), axis=1)
    if (far := np.flatnonzero(steps > _MAX_STEP)).size:
        raise InputError(
            f"{name}: pose {far[0] + 1} is {steps[far[0]]:.1f} m from the one before it; give "
            f"poses at {RATE:.0f} Hz, at most {_MAX_STEP:.0f} m apart."
        )
    if steps.sum() < 20.0:
        raise InputError(f"{name}: only {steps.sum():.1f} m long; drive at least 20 m.")
    xz = T_wc[:, [0, 2], 3]
    moving = np.r_[True, np.linalg.norm(np.diff(_smooth(xz, 5), axis=0), axis=1) > 0.02]
    path = _smooth(xz[moving], 9)
    heading = _headings(path)
    right = np.stack([np.cos(heading), -np.sin(heading)], axis=1)
    middle = path - _LANE * right
    direction = np.array([np.sin(heading[[0, -1]]), np.cos(heading[[0, -1]])]).T
    behind = middle[0] - np.linspace(40, 0.5, 80)[:, None] * direction[0]
    ahead = middle[-1] + np.linspace(0.5, 130, 200)[:, None] * direction[1]
    roads = roads_of([np.vstack([behind, middle, ahead])], same_road=5.0)
    terrain = _terrain(roads.xz, _heights_of(xz, -T_wc[:, 1, 3] - CAMERA_HEIGHT))
    poses = T_wc.copy()
    poses[:, 1, 3] = -terrain.height(xz) - CAMERA_HEIGHT
    return Route(
        name, f"{len(T_wc)} given poses", "town", _CAMERAS[calibration], poses, roads, terrain
    )


def _round_corners(leg: _Leg) -> tuple[Float, Float]:
    """Sample the middle line of the road every 0.25 m, with arcs at the corners.

    Returns:
        ``(K, 2)`` positions, and the ``(K,)`` lane at each of them.
    """
    corners = np.array(leg.corners, np.float64)
    lanes = np.array(leg.lanes or (1.0,) * len(corners))
    points, lane = [corners[0][None]], [lanes[:1]]
    for k in range(1, len(corners) - 1):
        a, b = corners[k - 1] - corners[k], corners[k + 1] - corners[k]
        la, lb = np.linalg.norm(a), np.linalg.norm(b)
        a, b = a / la, b / lb
        opening = np.arccos(np.clip(a @ b, -1, 1))
        reach = min(leg.radius / np.tan(opening / 2), 0.49 * min(la, lb))
        start, end = corners[k] + reach * a, corners[k] + reach * b
        radius = reach * np.tan(opening / 2)
        bisector = a + b
        if np.linalg.norm(bisector) < 1e-3:
            points.append(corners[k][None])
            lane.append(lanes[k : k + 1])
            continue
        centre = corners[k] + bisector / np.linalg.norm(bisector) * radius / np.sin(opening / 2)
        angle = np.linspace(0, 1, 40)
        v0, v1 = start - centre, end - centre
        sweep = np.pi - opening
        arc = np.sin((1 - angle) * sweep)[:, None] * v0 + np.sin(angle * sweep)[:, None] * v1
        points.append(
            centre + arc / np.sin(sweep) if np.sin(sweep) > 1e-3 else np.stack([start, end])
        )
        lane.append(np.full(len(points[-1]), lanes[k]))
    points.append(corners[-1][None])
    lane.append(lanes[-1:])
    line, value = np.vstack(points), np.concatenate(lane)
    along = np.cumsum(np.r_[0, np.linalg.norm(np.diff(line, axis=0), axis=1)])
    keep = np.r_[True, np.diff(along) > 1e-9]
    at = np.arange(0, along[-1], 0.25)
    dense = np.stack([np.interp(at, along[keep], line[keep, i]) for i in (0, 1)], axis=1)
    # A change of lane takes about 20 m.
    return _smooth(dense, 25), _smooth(np.interp(at, along[keep], value[keep])[:, None], 81)[:, 0]


def _smooth(values: Float, window: int) -> Float:
    """Apply a moving average twice. The first and last values do not change."""
    half = window // 2
    for _ in range(2):
        first, last = values[:1], values[-1:]
        head = 2 * first - values[half:0:-1]
        tail = 2 * last - values[-2 : -half - 2 : -1]
        padded = np.vstack([head, values, tail])
        total = np.cumsum(np.vstack([np.zeros((1, values.shape[1])), padded]), axis=0)
        values = (total[window:] - total[:-window])[: len(values)] / window
    return values


def _headings(line: Float) -> Float:
    step = np.gradient(line, axis=0)
    return np.unwrap(np.arctan2(step[:, 0], step[:, 1]))


def _drive(path: Float, speed: float) -> Float:
    """Return ``(N, 2)`` positions at 10 Hz of a car that follows a path and slows down in bends."""
    along = np.cumsum(np.r_[0, np.linalg.norm(np.diff(path, axis=0), axis=1)])
    keep = np.r_[True, np.diff(along) > 1e-9]
    along, path = along[keep], path[keep]
    curvature = np.abs(np.gradient(_headings(path), along))
    limit = np.minimum(
        speed, np.sqrt(2.4 / np.maximum(_smooth(curvature[:, None], 41)[:, 0], 1e-4))
    )
    limit = np.maximum(_smooth(limit[:, None], 61)[:, 0], 2.5)
    time = np.cumsum(np.r_[0, np.diff(along) / (0.5 * (limit[1:] + limit[:-1]))])
    at = np.interp(np.arange(0, time[-1], 1 / RATE), time, along)
    return np.stack([np.interp(at, along, path[:, k]) for k in (0, 1)], axis=1)


def _poses(xz: Float, terrain: Terrain) -> Float:
    """Make ``(N, 4, 4)`` camera poses along a path. Heading and pitch sway slightly."""
    up = terrain.height(xz)
    smooth = _smooth(np.column_stack([xz, up]), 7)
    step = np.gradient(smooth, axis=0)
    heading = np.unwrap(np.arctan2(step[:, 0], step[:, 1]))
    t = np.arange(len(xz)) / RATE
    pitch = np.arctan2(step[:, 2], np.hypot(step[:, 0], step[:, 1]))
    pitch = pitch + 0.0022 * np.sin(8.2 * t) * np.sin(0.7 * t) + 0.001 * np.sin(11.0 * t + 1)
    roll = 0.0025 * np.sin(5.1 * t + 2) * np.sin(0.43 * t)
    T = np.tile(np.eye(4), (len(xz), 1, 1))
    ch, sh, cp, sp, cr, sr = (f(a) for a in (heading, pitch, roll) for f in (np.cos, np.sin))
    zero, one = np.zeros_like(t), np.ones_like(t)
    yaw = np.array([[ch, zero, sh], [zero, one, zero], [-sh, zero, ch]]).transpose(2, 0, 1)
    nod = np.array([[one, zero, zero], [zero, cp, -sp], [zero, sp, cp]]).transpose(2, 0, 1)
    lean = np.array([[cr, -sr, zero], [sr, cr, zero], [zero, zero, one]]).transpose(2, 0, 1)
    T[:, :3, :3] = yaw @ nod @ lean
    T[:, 0, 3], T[:, 2, 3] = xz.T
    T[:, 1, 3] = -up - CAMERA_HEIGHT
    return T


def _waves(xz: Float, seed: int) -> Float:
    """Return ``(N,)`` heights of hills with amplitude 1 at ``(N, 2)`` positions."""
    rng = np.random.default_rng(seed)
    total = np.zeros(len(xz))
    for k in range(4):
        angle, phase = rng.uniform(0, np.pi), rng.uniform(0, 2 * np.pi)
        length = (420.0, 330.0, 260.0, 180.0)[k]
        way = xz @ np.array([np.cos(angle), np.sin(angle)])
        total += (0.4, 0.3, 0.2, 0.1)[k] * np.sin(2 * np.pi * way / length + phase)
    return total


def _terrain(xz: Float, height: Callable[[Float], Float]) -> Terrain:
    low, high = xz.min(axis=0) - 170.0, xz.max(axis=0) + 170.0
    cell = 6.4
    low = np.floor(low / cell) * cell
    columns, rows = np.ceil((high - low) / cell).astype(int) + 1
    at = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), -1).reshape(-1, 2)
    return Terrain(low, cell, height(low + cell * at).reshape(rows, columns))


def _heights_of(xz: Float, up: Float) -> Callable[[Float], Float]:
    """Make a smooth height function. The heights of a place that is passed twice are averaged.

    Args:
        xz: ``(N, 2)`` positions.
        up: ``(N,)`` heights at these positions.
    """
    from scipy.spatial import cKDTree

    tree = cKDTree(xz)
    averaged = np.array([up[near].mean() for near in tree.query_ball_point(xz, 6.0)])

    def height(at: Float) -> Float:
        distance, near = tree.query(at, k=min(24, len(xz)))
        # Away from the road, the ground has the height of the road.
        scale = np.maximum(distance[:, :1], 8.0)
        weight = np.exp(-0.5 * ((distance - distance[:, :1]) / scale) ** 2)
        return np.asarray((averaged[near] * weight).sum(axis=1) / weight.sum(axis=1))

    return height
