"""Drive through a grid of new streets until the map is large, and close one loop at the end.

    python tools/experiments/scale/drive.py --keyframes 10000 --out drive.csv

The streets are drawn while the camera drives: walls, ground and sky with a random pattern that
never repeats. The camera takes one street after the other, returns to the first one along an outer
road, and drives a part of it again. Times are CPU times of one core, without drawing. Each row is
for a part of the drive, the last one for the loop.
"""

from __future__ import annotations

import argparse
import csv
import time
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d

from vslam import Camera, Slam, TrackingState
from vslam.support.kernels import inline, kernel
from vslam.support.machine import peak_memory_mb

Float = NDArray[np.float64]

CAMERA = Camera(170.0, 170.0, 159.5, 55.5, 0.5, 320, 112)
STREET, APART, HALF = 400.0, 60.0, 6.0  # length, distance and half width of the streets, in metres
EYE = 1.65  # height of the camera above the ground, in metres
STEP, TURN = 2.5, np.radians(5.0)  # largest motion between frames, in metres and radians
CURVE = 16.0  # metres over which the path is smoothed
AGAIN = 200.0  # metres of the first street that are driven again
CELLS, STRENGTHS = (3.2, 0.8, 0.2), (60.0, 90.0, 70.0)  # metres, grey levels
SETTINGS = {"orb.n_features": 800}


@dataclass(frozen=True)
class Streets:
    """N parallel streets, whose ends are connected by roads on both sides, and a drive.

    The i-th street is the line ``z = APART i`` from ``x = 0`` to ``x = STREET``.

    Attributes:
        T_wc: ``(F, 4, 4)`` poses of the left camera.
        returns: the frame at which the first street begins again.
    """

    n: int
    T_wc: Float
    returns: int


def plan(n: int) -> Streets:
    """Plan a drive along ``n`` streets, an even number."""
    corners = [(STREET * (k % 4 in (1, 2)), APART * (k // 2)) for k in range(2 * n)]
    corners += [(0.0, 0.0), (AGAIN, 0.0)]
    pieces = []
    for (x, z), (to_x, to_z) in pairwise(corners):
        steps = round(10 * (abs(to_x - x) + abs(to_z - z)))
        pieces.append(np.linspace((x, z), (to_x, to_z), steps, endpoint=False))
    path = np.concatenate(pieces)
    back = len(path) - len(pieces[-1])
    for _ in range(2):
        path = uniform_filter1d(path, round(10 * CURVE / 2), axis=0, mode="nearest")
    ahead = np.gradient(path, axis=0)
    turns = np.unwrap(np.arctan2(ahead[:, 0], ahead[:, 1]))
    frames = np.hypot(*np.diff(path, axis=0).T) / STEP + np.abs(np.diff(turns)) / TURN
    frames = np.concatenate([[0.0], np.cumsum(frames)])
    at = np.interp(np.arange(0.0, frames[-1]), frames, np.arange(len(frames)))
    turn = np.interp(at, np.arange(len(turns)), turns)
    T_wc = np.tile(np.eye(4), (len(at), 1, 1))
    T_wc[:, 0, 0] = T_wc[:, 2, 2] = np.cos(turn)
    T_wc[:, 0, 2], T_wc[:, 2, 0] = np.sin(turn), -np.sin(turn)
    for k, axis in enumerate((0, 2)):
        T_wc[:, axis, 3] = np.interp(at, np.arange(len(path)), path[:, k])
    return Streets(n, T_wc, int(np.searchsorted(at, back)))


@inline
def random(a, b, c):
    """Hash three whole numbers to a number from 0 to 1."""
    h = np.uint32(a) * np.uint32(0x9E3779B1) ^ np.uint32(b) * np.uint32(0x85EBCA77)
    h = (h ^ np.uint32(c) * np.uint32(0xC2B2AE3D)) * np.uint32(0x27D4EB2F)
    h = (h ^ (h >> np.uint32(15))) * np.uint32(0x2545F491)
    return float((h ^ (h >> np.uint32(13))) & np.uint32(0xFFFF)) / 65535.0


@inline
def pattern(a, b, number, footprint):
    """Return the grey value of a surface at ``(a, b)`` metres. Details below a pixel fade out."""
    grey = 120.0
    for k in range(3):
        fade = min(1.0, max(0.0, CELLS[k] / footprint - 1.0))
        if fade > 0.0:
            x, y = a / CELLS[k], b / CELLS[k]
            i, j = int(np.floor(x)), int(np.floor(y))
            s, t = x - i, y - j
            s, t = s * s * (3.0 - 2.0 * s), t * t * (3.0 - 2.0 * t)
            key = 3 * number + k
            top = (1.0 - s) * random(i, j, key) + s * random(i + 1, j, key)
            low = (1.0 - s) * random(i, j + 1, key) + s * random(i + 1, j + 1, key)
            grey += fade * STRENGTHS[k] * ((1.0 - t) * top + t * low - 0.5)
    return grey


@inline
def wall_ahead(x, z, dx, dz, n):
    """Follow a ray on the ground until it meets a wall.

    Returns:
        The length in units of the ray, the position along the wall, and the number of the wall.
    """
    length = 0.0
    for _ in range(4 * n + 8):
        street = int(np.floor(z / APART + 0.5))
        in_street = abs(z - APART * street) < HALF
        left, right = x < HALF, x > STREET - HALF
        if dx > 0.0:
            line_x = HALF if left else (STREET + HALF if right else STREET - HALF)
        else:
            line_x = STREET - HALF if right else (-HALF if left else HALF)
        if in_street:
            line_z = APART * street + (HALF if dz > 0.0 else -HALF)
        else:
            block = np.floor(z / APART)
            line_z = APART * (block + 1.0) - HALF if dz > 0.0 else APART * block + HALF
        to_x = (line_x - x) / dx if dx != 0.0 else 1e9
        to_z = (line_z - z) / dz if dz != 0.0 else 1e9
        step = max(min(to_x, to_z), 0.0)
        length += step
        if to_x < to_z:
            z += step * dz
            x = line_x + (1e-7 if dx > 0.0 else -1e-7)
            outside = line_x < 0.0 or line_x > STREET
            into_block = not in_street and ((left and dx > 0.0) or (right and dx < 0.0))
            if outside or into_block:
                return length, z, 2 * int(line_x) + 1
        else:
            x += step * dx
            z = line_z + (1e-7 if dz > 0.0 else -1e-7)
            outside = line_z < 0.0 or line_z > APART * (n - 1)
            if outside or (in_street and not (x < HALF or x > STREET - HALF)):
                return length, x, 2 * int(line_z) + 4000
    return length, 0.0, 0


@kernel
def draw(T_wc, fx, cx, cy, width, height, n, image):
    """Draw the ``(H, W)`` uint8 image that a camera sees."""
    lengths, along = np.empty(width), np.empty(width)
    walls = np.empty(width, np.int64)
    x, z = T_wc[0, 3], T_wc[2, 3]
    for u in range(width):
        ray = (u - cx) / fx
        dx, dz = T_wc[0, 0] * ray + T_wc[0, 2], T_wc[2, 0] * ray + T_wc[2, 2]
        lengths[u], along[u], walls[u] = wall_ahead(x, z, dx, dz, n)
    for u in range(width):
        ray, depth = (u - cx) / fx, lengths[u]
        near = u + 1 if u + 1 < width else u - 1
        footprint = depth / fx
        if walls[near] == walls[u]:
            footprint = max(footprint, abs(along[near] - along[u]))
        house = int(np.floor(along[u] / 9.0))
        roof = EYE - 4.0 - 8.0 * random(house, 0, walls[u])
        tone = 60.0 * random(house, 1, walls[u]) - 30.0
        for v in range(height):
            y = (v - cy) / fx * depth
            if y > EYE:
                far = EYE * fx / (v - cy)
                a = x + far * (T_wc[0, 0] * ray + T_wc[0, 2])
                b = z + far * (T_wc[2, 0] * ray + T_wc[2, 2])
                grey = pattern(a, b, 1, far * far / (EYE * fx)) - 20.0
            elif y < roof:
                grey = 225.0
            else:
                grey = pattern(along[u], y, walls[u] + 10, footprint) + tone
            image[v, u] = np.uint8(min(255.0, max(0.0, grey)))


def stereo_pair(streets: Streets, k: int) -> list[NDArray[np.uint8]]:
    """Draw the left and the right image of a frame."""
    pair = []
    for shift in (0.0, CAMERA.baseline):
        T_wc = streets.T_wc[k].copy()
        T_wc[:3, 3] += shift * T_wc[:3, 0]
        image = np.empty((CAMERA.height, CAMERA.width), np.uint8)
        draw(T_wc, CAMERA.fx, CAMERA.cx, CAMERA.cy, CAMERA.width, CAMERA.height, streets.n, image)
        pair.append(image)
    return pair


def row(part: str, slam: Slam, times: list[float], lost: int) -> dict[str, str]:
    seconds = np.array(times)
    return {
        "part": part,
        "frames": str(len(times)),
        "lost": str(lost),
        "keyframes": str(slam.map.n_keyframes),
        "landmarks": str(slam.map.n_landmarks),
        "loops": str(sum(edge.accepted for edge in slam.loops)),
        "frames_per_second": f"{len(times) / seconds.sum():.1f}",
        "median_ms": f"{1e3 * np.median(seconds):.1f}",
        "worst_ms": f"{1e3 * seconds.max():.0f}",
        "memory_mb": f"{peak_memory_mb():.0f}",
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--keyframes", type=int, default=10000, help="before the loop")
    parser.add_argument("--frames-per-keyframe", type=float, default=1.43, help="on straight roads")
    parser.add_argument("--part", type=int, default=1000, help="frames of a row")
    parser.add_argument("--detector", default="bow")
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    metres = options.keyframes * options.frames_per_keyframe * STEP
    streets = plan(2 * max(1, round(metres / (STREET + APART) / 2)))
    slam = Slam(CAMERA, SETTINGS, options.detector, threads=1)
    rows: list[dict[str, str]] = []
    times: list[float] = []
    lost = 0
    for k in range(len(streets.T_wc)):
        left, right = stereo_pair(streets, k)
        ends = len(times) + 1 == options.part or k + 1 in (streets.returns, len(streets.T_wc))
        start = time.process_time()
        result = slam.step(left, right, 0.1 * k)
        if ends:
            slam.finish()  # the map can be read only while no keyframe is being mapped
        times.append(time.process_time() - start)
        lost += result.state is TrackingState.LOST
        if ends:
            rows.append(row(f"until frame {k + 1}", slam, times, lost))
            print(rows[-1], flush=True)
            times, lost = [], 0
    found = slam.trajectory().T_wc
    truth = np.linalg.inv(streets.T_wc[0]) @ streets.T_wc
    errors = np.linalg.norm(found[:, :3, 3] - truth[:, :3, 3], axis=1)
    print(f"error after the return: {errors[streets.returns :].max():.2f} m, "
          f"elsewhere at most {errors.max():.2f} m")  # fmt: skip
    with options.out.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, rows[0], lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


if __name__ == "__main__":
    main()
