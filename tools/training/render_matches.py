"""Render pairs of views with exact correspondences, for training the local descriptors.

Each pair shows one place of a rendered town twice, with differences such as another lane, direction
or position, other cars and posters, another light, dusk or night. The images, depths and relative
poses of each town are written to one ``.npz``, which ``train_local.py`` reads.

    python tools/training/render_matches.py --out matches --pairs 48
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from vslam.datasets.synthetic import built_in_route
from vslam.datasets.synthetic.camera_effects import sensor_image
from vslam.datasets.synthetic.passes import Passes
from vslam.datasets.synthetic.render import Renderer
from vslam.datasets.synthetic.routes import Route
from vslam.datasets.synthetic.site import Variation
from vslam.datasets.synthetic.solids import turn
from vslam.datasets.synthetic.town import Town, build_town

WIDTH = 640  # pixels, the network's input
# Seeds (of no test town), route, change, and whether the town repeats a few facades.
TOWNS = [
    (61, "demo", 0.95, False), (62, "05", 1.0, False), (63, "00", 0.9, False),
    (64, "demo", 1.0, True), (65, "02", 1.0, False), (66, "05", 0.6, True),
    (67, "00", 1.0, False), (68, "demo", 0.5, False), (69, "05", 0.95, False),
    (70, "02", 0.9, False), (71, "demo", 1.0, False), (72, "00", 0.8, False),
    (73, "05", 1.0, False), (74, "demo", 0.9, True), (75, "02", 1.0, False),
    (76, "00", 1.0, False), (77, "05", 0.9, False), (78, "demo", 1.0, False),
    (79, "00", 0.95, True), (80, "05", 1.0, False), (81, "02", 0.95, False),
    (82, "demo", 0.9, False), (83, "00", 1.0, False), (84, "05", 0.85, False),
]  # fmt: skip
LATERAL = (-3.6, 1.4)  # m to the right; -3.2 is the other lane
FORWARD = (-4.0, 4.0)  # m
HEADING = 25.0  # degrees to either side, at most
_EXPOSURE = 0.3  # standard deviation of the log exposure


def moved(T_wc: NDArray[np.float64], lateral: float, forward: float, degrees: float) -> NDArray:
    """The pose ``T_wc`` shifted to the right and forward, and turned."""
    out = T_wc.copy()
    out[:3, :3] = turn(np.radians(degrees)) @ T_wc[:3, :3]
    out[:3, 3] += lateral * T_wc[:3, 0] + forward * T_wc[:3, 2]
    return out


def view(
    renderer: Renderer, route: Route, passes: Passes, T_wc: NDArray[np.float64], when: int,
    exposure: float, key: tuple[int, int, int],
) -> tuple[NDArray[np.uint8], NDArray[np.float16]]:  # fmt: skip
    """Image and depth at the network's input size."""
    from dataclasses import replace

    moment = passes.at(when)
    light = replace(moment.light, exposure=moment.light.exposure * exposure)
    (seen,) = renderer.views(moment.surfaces, moment.shadows, light, [T_wc], moment.pools)
    image = sensor_image(seen.image, route.camera, yaw_rate=0.0, night=moment.night, key=key)
    height = round(route.camera.height * WIDTH / route.camera.width)
    small = cv2.resize(image, (WIDTH, height), interpolation=cv2.INTER_AREA)
    depth = cv2.resize(seen.depth, (WIDTH, height), interpolation=cv2.INTER_NEAREST)
    return np.asarray(small, np.uint8), depth.astype(np.float16)


def render_town(town: tuple[int, str, float, bool], pairs: int, folder: Path, threads: int) -> Path:
    """Render the pairs of one town, unless they exist."""
    seed, name, change, aliased = town
    path = folder / f"{seed}.npz"
    if path.exists():
        return path
    route = built_in_route(name)
    variation = Variation(seed, aliased, change, 0)
    built: Town = build_town(route, variation, (LATERAL[0], LATERAL[1], 0.0))
    passes = Passes(route, built, variation)
    renderer = Renderer(route.camera, built.atlas, built.sky, threads)
    rng = np.random.default_rng([seed, 40])
    last = len(route.T_wc) - 1
    images, depths, motions, whens = [], [], [], []
    for k in range(pairs):
        frame = int(rng.integers(last + 1))
        T_a = route.T_wc[frame]
        heading = float(np.clip(rng.normal(0.0, 8.0), -HEADING, HEADING))
        lateral = float(rng.choice([rng.uniform(*LATERAL), rng.uniform(-0.7, 0.7), -3.2]))
        T_b = moved(T_a, lateral, float(rng.uniform(*FORWARD)), heading)
        # One by day, the other at any hour.
        when = int(rng.integers(last // 4 + 1)), int(rng.integers(last + 1))
        exposures = np.exp(rng.normal(0.0, _EXPOSURE, 2))
        seen = [
            view(renderer, route, passes, T, w, float(e), (seed, k, side))
            for side, (T, w, e) in enumerate(zip((T_a, T_b), when, exposures, strict=True))
        ]
        images.append([image for image, _ in seen])
        depths.append([depth for _, depth in seen])
        motions.append(np.linalg.inv(T_b) @ T_a)
        whens.append(when)
    renderer.close()
    scale = WIDTH / route.camera.width
    c = route.camera
    intrinsics = scale * np.array([c.fx, c.fy, c.cx + 0.5, c.cy + 0.5]) - [0.0, 0.0, 0.5, 0.5]
    folder.mkdir(parents=True, exist_ok=True)
    part = path.with_suffix(".part")
    with part.open("wb") as file:
        np.savez(
            file, image=np.array(images), depth=np.array(depths), T_b_a=np.array(motions),
            intrinsics=intrinsics, when=np.array(whens) / last, change=change,
        )  # fmt: skip
    part.replace(path)
    return path


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--pairs", type=int, default=48, help="of each town")
    parser.add_argument("--threads", type=int, default=2)
    given = parser.parse_args()
    for town in TOWNS:
        began = time.perf_counter()
        path = render_town(town, given.pairs, given.out, given.threads)
        sys.stdout.write(f"{path}: {time.perf_counter() - began:.0f} s\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
