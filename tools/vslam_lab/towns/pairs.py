"""Renders labelled pairs of images, which are used to train loop detectors."""

from __future__ import annotations

import csv
import io
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from vslam.types.camera import Camera
from vslam_lab.towns import solids
from vslam_lab.towns.files import check_disk, write_png, writing
from vslam_lab.towns.passes import Passes
from vslam_lab.towns.render import Renderer, sensor_image
from vslam_lab.towns.routes import Route
from vslam_lab.towns.site import Variation
from vslam_lab.towns.store import OnFrame
from vslam_lab.towns.town import Town, build_town

_HEIGHT = 0.25  # m, largest change of the camera's height
_EXPOSURE = 0.25  # standard deviation of the logarithm of the ratio of the two exposures
# Two places are different if they are more than _APART metres apart and not in the same street. Two
# places are in the same street if their headings are parallel, their distance is below _SIGHT
# metres, and their distance across the street is below _STREET metres.
_APART, _SIGHT, _STREET = 40.0, 160.0, 25.0
# Two frames belong to two passes through one place if they differ by at most 4 m and 30 degrees and
# are more than 60 frames apart.
_TOGETHER, _ALIGNED, _LATER = 4.0, 30.0, 60
_ALIKE = 5  # for each place, the number of different places that are used as the most similar ones
_PLACES, _SMALL = 160, 8  # number of places that are compared; factor by which views are reduced
KINDS = ("shift", "alike", "pass", "random")
_COLUMNS = ("a", "b", "same", "kind", "frame_a", "frame_b", "when_a", "when_b", "distance_m",
            "lateral_m", "heading_deg", "height_m", "exposure_ratio",
            "x_a", "z_a", "yaw_a", "x_b", "z_b", "yaw_b")  # fmt: skip

Float = NDArray[np.float64]


@dataclass(frozen=True)
class Moves:
    """Ranges (lowest, highest) of the random camera motion between the two images of a pair.

    Attributes:
        lateral: lateral shift of the second camera to the right in metres. At -3.2, the camera is
            on the other lane.
        heading: rotation of the second camera to either side in degrees.
    """

    lateral: tuple[float, float] = (-1.4, 1.4)
    heading: tuple[float, float] = (0.0, 14.0)


def render_pairs(
    route: Route,
    variation: Variation,
    folder: Path,
    count: int,
    moves: Moves = Moves(),
    *,
    kinds: tuple[str, ...] = KINDS,
    threads: int = 2,
    on_frame: OnFrame | None = None,
) -> None:
    """Render labelled pairs of images.

    The kind of a pair tells where its second image is taken:

    - ``shift``: at the same frame of the drive.
    - ``pass``: at the same place, but when the camera returned to it, if the drive has such a
      revisit.
    - ``alike``: at a different place that looks similar in small, blurred images.
    - ``random``: at any different place.

    The camera of the second image is also moved at random. If all kinds are rendered, half of the
    pairs show the same place.

    ``folder/pairs.csv`` has one row per pair, with these columns:

    - the two image files, whether the images show the same place (1 or 0), and the kind of the
      pair;
    - for each image, the frame at whose position it is taken, and the frame whose light and objects
      it shows;
    - the distance between the two frames (m);
    - the lateral shift (m), the rotation (degrees) and the rise (m) of the second camera;
    - the ratio of the exposures;
    - for each camera, x and z in metres and the yaw in degrees from z towards x.

    Args:
        route: drive from which places are taken.
        variation: variation of the town. ``aliased`` makes different places more similar.
            ``change`` makes the images of one place differ as if they were taken on different days.
        count: number of pairs.
        moves: motion of the second camera.
        kinds: the kinds to render, in turn.
        threads: number of threads of the renderer.
        on_frame: called with the number of finished pairs and ``count``.

    Raises:
        InputError: the folder cannot be written, or the disk is too small.
    """
    check_disk(folder, count, depth=False)
    rng = np.random.default_rng([variation.seed, 20])
    town = build_town(route, variation, (*moves.lateral, 0.0))
    passes = Passes(route, town, variation)
    alike = _look_alikes(route, town, passes, threads) if "alike" in kinds else None
    again = _other_passes(route.T_wc)
    returns = np.flatnonzero([len(others) > 0 for others in again])
    places = route.T_wc[:, [0, 2], 3]
    last = len(places) - 1
    renderer = Renderer(route.camera, town.atlas, town.sky, threads)
    table = io.StringIO()
    rows = csv.writer(table)
    rows.writerow(_COLUMNS)
    with closing(renderer), writing(folder):
        (folder / "images").mkdir(parents=True, exist_ok=True)
        for k in range(count):
            kind = kinds[k % len(kinds)]
            if kind == "pass" and not returns.size:
                kind = "shift"
            first = int(rng.choice(returns) if kind == "pass" else rng.integers(len(places)))
            second = first
            if kind == "pass":
                second = int(rng.choice(again[first]))
            elif alike is not None and kind == "alike":
                first, second = (int(x) for x in alike[int(rng.integers(len(alike)))])
            elif kind == "random":
                apart = np.flatnonzero(_different(route.T_wc[first], route.T_wc))
                second = int(rng.choice(apart)) if apart.size else last - first
            moments = (first, last if kind == "shift" and variation.change > 0 else second)
            turn = rng.uniform(*moves.heading) * rng.choice([-1.0, 1.0])
            shift = (rng.uniform(*moves.lateral), turn, rng.uniform(-_HEIGHT, _HEIGHT))
            ratio = float(np.exp(rng.normal(0.0, _EXPOSURE)))
            names: list[str] = []
            cameras: list[float] = []
            for number, (frame, moment) in enumerate(zip((first, second), moments, strict=True)):
                T = route.T_wc[frame] if number == 0 else _shifted(route.T_wc[frame], *shift)
                image = _view(renderer, route, passes, T, moment, 1.0 if number == 0 else ratio,
                              key=(variation.seed, k, number))  # fmt: skip
                names.append(f"images/{k:06d}_{'ab'[number]}.png")
                write_png(folder / names[-1], image, 1)
                yaw = float(np.degrees(np.arctan2(T[0, 2], T[2, 2])))
                cameras += [T[0, 3], T[2, 3], yaw]
            distance = float(np.linalg.norm(places[second] - places[first]))
            rows.writerow([
                *names, int(kind in ("shift", "pass")), kind, first, second, *moments,
                *(f"{x:.3f}" for x in (distance, *shift, ratio, *cameras)),
            ])  # fmt: skip
            if on_frame:
                on_frame(k + 1, count)
        (folder / "pairs.csv").write_text(table.getvalue())


def _view(
    renderer: Renderer, route: Route, passes: Passes, T_wc: Float, when: int, ratio: float,
    *, key: tuple[int, int, int],
) -> NDArray[np.uint8]:  # fmt: skip
    moment = passes.at(when)
    light = replace(moment.light, exposure=moment.light.exposure * ratio)
    (view,) = renderer.views(replace(moment, light=light), T_wc)
    return sensor_image(view.image, route.camera, yaw_rate=0.0, night=moment.night, key=key)


def _other_passes(T_wc: Float) -> list[NDArray[np.int64]]:
    """For each frame, find the frames of other passes with a similar position and heading."""
    xz, ahead = T_wc[:, [0, 2], 3], T_wc[:, :3, 2]
    again = []
    for k, near in enumerate(cKDTree(xz).query_ball_point(xz, _TOGETHER)):
        others = np.array(near, np.int64)
        others = others[np.abs(others - k) > _LATER]
        again.append(others[ahead[others] @ ahead[k] > np.cos(np.radians(_ALIGNED))])
    return again


def _different(T_wc: Float, others: Float) -> NDArray[np.bool_]:
    """Return which of N poses are at a different place than ``T_wc`` and not in its street."""
    away = (others[:, :3, 3] - T_wc[:3, 3])[:, [0, 2]]
    ahead = T_wc[[0, 2], 2] / np.linalg.norm(T_wc[[0, 2], 2])
    aside = np.abs(away @ np.array([ahead[1], -ahead[0]]))
    distance = np.linalg.norm(away, axis=1)
    parallel = np.abs(others[:, [0, 2], 2] @ ahead) > 0.7
    same_street = parallel & (aside < _STREET) & (distance < _SIGHT)
    return np.asarray((distance > _APART) & ~same_street)


def _look_alikes(route: Route, town: Town, passes: Passes, threads: int) -> NDArray[np.int64]:
    """Find pairs of frames that look similar although they show different places.

    The similarity of two places is the correlation of their images, after the images were reduced
    in size, blurred and normalised.

    Returns:
        ``(P, 2)`` frame indices. There are several pairs for each place.
    """
    chosen = np.unique(np.linspace(0, len(route.T_wc) - 1, _PLACES).astype(int))
    c = route.camera
    fx, fy, cx, cy = (x / _SMALL for x in (c.fx, c.fy, c.cx, c.cy))
    small = Camera(fx, fy, cx, cy, c.baseline, c.width // _SMALL, c.height // _SMALL)
    renderer = Renderer(small, town.atlas, town.sky, threads)
    moment = passes.at(0)
    seen = []
    with closing(renderer):
        for k in chosen:
            (view,) = renderer.views(moment, route.T_wc[k])
            blurred = cv2.GaussianBlur(np.minimum(view.image, 255.0), (0, 0), 1.5).ravel()
            seen.append((blurred - blurred.mean()) / (blurred.std() + 1e-6))
    score = np.array(seen) @ np.array(seen).T / seen[0].size
    for k, T in enumerate(route.T_wc[chosen]):
        score[k, ~_different(T, route.T_wc[chosen])] = -np.inf
    pairs = [
        (int(chosen[k]), int(chosen[other]))
        for k, row in enumerate(score)
        for other in np.argsort(-row)[:_ALIKE]
        if np.isfinite(row[other])
    ]
    return np.array(pairs or [(int(chosen[0]), int(chosen[-1]))], np.int64)


def _shifted(T_wc: Float, lateral: float, heading: float, height: float) -> Float:
    moved = T_wc.copy()
    moved[:3, :3] = solids.turn(np.radians(heading)) @ T_wc[:3, :3]
    moved[:3, 3] += lateral * T_wc[:3, 0] + [0.0, -height, 0.0]
    return moved
