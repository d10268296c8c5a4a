r"""Compare matching by learned local descriptors and by ORB on rendered pairs of views.

The pairs show test towns with exact depth and motion. For each condition, a CSV table gives the
share of the matches within 3 pixels of the truth, and the error of the pose from P3P and its
refinement. Both use the ORB keypoints of the first view.

    python tools/experiments/local_descriptors/local_accuracy.py --pairs 24 \
        --out docs/research/loops/local_descriptors.csv
"""

from __future__ import annotations

import argparse
import csv
import sys
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).parents[2] / "training"))

from render_matches import moved

from vslam.camera import Camera
from vslam.config import Config
from vslam.datasets.synthetic import built_in_route
from vslam.datasets.synthetic.camera_effects import sensor_image
from vslam.datasets.synthetic.passes import Passes
from vslam.datasets.synthetic.render import Renderer
from vslam.datasets.synthetic.site import Variation
from vslam.datasets.synthetic.town import build_town
from vslam.features import FeatureGrid
from vslam.frontend.matching import Projections, Searchable, search_all, search_windows
from vslam.frontend.orb import Extraction, extract, scale_factors
from vslam.frontend.pnp import ransac_pose
from vslam.frontend.pose import optimise_pose
from vslam.loopclosure.learned_localisation import project
from vslam.loopclosure.local_matching import locate, locate_near, match_coarse
from vslam.loopclosure.siamese.local_descriptors import LocalDescriptors
from vslam.reprojection import stack_uvr

CONFIG = Config()
PIXELS = 3.0
DEPTHS = 1.0, 80.0  # range of the depths of evaluated keypoints, m


class Condition(NamedTuple):
    """Changes in the second view: metres to the right, degrees, town, hour of the drive."""

    name: str
    lateral: float
    heading: float
    change: float
    hour: float


CONDITIONS = (
    Condition("unchanged", 0.3, 3.0, 0.0, 0.0),
    Condition("other lane", -3.2, 3.0, 0.0, 0.0),
    Condition("turned 20 degrees", 0.3, 20.0, 0.0, 0.0),
    Condition("change 0.7", 0.3, 3.0, 0.7, 1.0),
    Condition("other lane, change 0.7", -3.2, 3.0, 0.7, 1.0),
    Condition("dusk", 0.3, 3.0, 0.85, 1.0),
    Condition("night", 0.3, 3.0, 1.0, 1.0),
    Condition("other lane by night", -3.2, 3.0, 1.0, 1.0),
)


class Errors(NamedTuple):
    """For one pair: matches, share within 3 pixels, pose errors in metres and degrees."""

    matches: int
    within: float
    metres: float
    degrees: float


def judged(
    points: NDArray[np.float64], uv: NDArray[np.float64], sigma: float, camera: Camera,
    T_b_a: NDArray[np.float64],
) -> tuple[Errors, NDArray[np.float64] | None]:  # fmt: skip
    """Evaluate matches of points of the first view with pixels of the second; adds a pose."""
    n = len(points)
    if n < CONFIG.relocalization.min_matches:
        return Errors(n, 0.0, np.inf, np.inf), None
    p = points @ T_b_a[:3, :3].T + T_b_a[:3, 3]
    truth = camera.project(p)[:, :2]
    within = float((np.linalg.norm(uv - truth, axis=1) < PIXELS).mean())
    uvr, weight = stack_uvr(uv, np.full(n, np.nan)), np.full(n, sigma**-2.0)
    config = CONFIG.learned
    T, inlier = ransac_pose(
        points, uvr, weight, camera.intrinsics, np.uint64(1),
        CONFIG.relocalization.min_consensus, config.max_draws, config.confidence,
    )  # fmt: skip
    if np.count_nonzero(inlier) < CONFIG.relocalization.min_consensus:
        return Errors(n, within, np.inf, np.inf), None
    T, _ = optimise_pose(T, points, uvr, weight, camera.intrinsics)
    return Errors(n, within, **pose_errors(T, T_b_a)), T


def pose_errors(T: NDArray[np.float64], truth: NDArray[np.float64]) -> dict[str, float]:
    """Metres and degrees between two poses of a camera."""
    turn = T[:3, :3].T @ truth[:3, :3]
    cosine = np.clip((np.trace(turn) - 1) / 2, -1, 1)
    apart = np.linalg.norm(T[:3, :3].T @ T[:3, 3] - truth[:3, :3].T @ truth[:3, 3])
    return {"metres": float(apart), "degrees": float(np.degrees(np.arccos(cosine)))}


def compare(
    condition: Condition, name: str, seed: int, pairs: int, network: LocalDescriptors
) -> list[tuple[Errors, Errors]]:
    """Errors of ORB and of the learned descriptors for the pairs of one town."""
    route = built_in_route(name)
    camera = route.camera
    variation = Variation(seed, False, condition.change, 0)
    town = build_town(route, variation, (condition.lateral, 0.0))
    passes = Passes(route, town, variation)
    renderer = Renderer(camera, town.atlas, town.sky, 2)
    rng = np.random.default_rng([seed, 41])
    last = len(route.T_wc) - 1
    found = []
    for k in range(pairs):
        T_a = route.T_wc[int(rng.integers(last + 1))]
        side = rng.choice([-1.0, 1.0])
        T_b = moved(T_a, condition.lateral, float(rng.uniform(-2, 2)), side * condition.heading)
        views = []
        for number, (T, when) in enumerate(((T_a, 0), (T_b, round(last * condition.hour)))):
            moment = passes.at(when)
            (view,) = renderer.views(
                moment.surfaces, moment.shadows, moment.light, [T], moment.pools
            )
            key = (seed, k, number)
            image = sensor_image(view.image, camera, yaw_rate=0.0, night=moment.night, key=key)
            views.append((image, view.depth))
        (image_a, depth), (image_b, _) = views
        a, b = (extract(image, CONFIG.orb) for image in (image_a, image_b))
        points, kept = lifted(a, depth, camera)
        T_b_a = np.linalg.inv(T_b) @ T_a
        match = search_all(
            a.descriptors.view(np.uint64)[kept], b.descriptors.view(np.uint64),
            CONFIG.verification.match_distance, CONFIG.verification.match_ratio,
        )  # fmt: skip
        hit = np.flatnonzero(match >= 0)
        orb, _ = judged(points[hit], b.xy[match[hit]].astype(np.float64), 1.5, camera, T_b_a)
        maps_a, maps_b = network.describe(image_a), network.describe(image_b)
        config = CONFIG.learned
        coarse = match_coarse(maps_a, maps_b, config.coarse_alike)
        there = locate(a.xy[kept], maps_a, maps_b, coarse, config.reach, config.alike)
        seen = there.found
        sigma = config.sigma / maps_b.scale
        learned, T = judged(points[seen], there.xy[seen], sigma, camera, T_b_a)
        for _ in range(2 if T is not None else 0):  # as verification does
            expected = project(points, T, camera)
            near = locate_near(
                a.xy[kept], expected, maps_a, maps_b, config.guided_reach, config.alike
            )
            n = np.count_nonzero(near.found)
            uvr = stack_uvr(near.xy[near.found], np.full(n, np.nan))
            T, _ = optimise_pose(
                T, points[near.found], uvr, np.full(n, sigma**-2.0), camera.intrinsics
            )
        if T is not None:
            T = refined_by_orb(T, points, a, kept, b, camera)
            learned = learned._replace(**pose_errors(T, T_b_a))
        found.append((orb, learned))
    renderer.close()
    return found


def refined_by_orb(
    T: NDArray[np.float64], points: NDArray[np.float64], a: Extraction, kept: NDArray[np.int64],
    b: Extraction, camera: Camera,
) -> NDArray[np.float64]:  # fmt: skip
    """The pose refined by ORB matches near the projections; unchanged if there are too few."""
    gates = CONFIG.verification
    uv = project(points, T, camera)
    inside = np.flatnonzero(np.isfinite(uv[:, 0]))
    scales = scale_factors(CONFIG.orb)
    octave = a.octave[kept][inside].astype(np.int64)
    grid = FeatureGrid.of_positions(b.xy, camera.width, camera.height)
    mono = np.full(len(b.xy), np.nan, np.float32)
    found, _ = search_windows(
        Projections(
            np.c_[uv[inside], np.full(len(inside), np.nan)],
            gates.first_window * scales[octave], octave - 1, octave + 1,
            a.descriptors.view(np.uint64)[kept][inside],
        ),
        Searchable(b.xy, b.octave, mono, b.descriptors.view(np.uint64), grid),
        np.ones(len(b.xy), np.bool_), gates.guided_distance, 1.0,
    )  # fmt: skip
    hit = np.flatnonzero(found >= 0)
    uvr = np.c_[b.xy[found[hit]], np.full(len(hit), np.nan)].astype(np.float64)
    better, inlier = optimise_pose(
        T, points[inside[hit]], uvr, scales[b.octave[found[hit]]] ** -2.0, camera.intrinsics
    )
    return better if np.count_nonzero(inlier) >= gates.min_inliers else T


def lifted(
    features: Extraction, depth: NDArray[np.float32], camera: Camera
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Points in the camera frame of the keypoints with a depth, and their indices."""
    z = depth[tuple(np.rint(features.xy).astype(int).T[::-1])].astype(np.float64)
    kept = np.flatnonzero((z > DEPTHS[0]) & (z < DEPTHS[1]))
    return camera.backproject(features.xy[kept], z[kept]), kept


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--pairs", type=int, default=24, help="of each town and condition")
    parser.add_argument("--towns", default="demo:101,05:102", help="ROUTE:SEED with commas")
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    cv2.setNumThreads(1)
    network = LocalDescriptors()
    towns = [town.split(":") for town in given.towns.split(",")]
    with given.out.open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["condition", "pairs", *(
            f"{kind}_{what}" for kind in ("orb", "learned")
            for what in ("matches", "within_3_px", "pose_found", "error_m", "error_deg")
        )])  # fmt: skip
        for condition in CONDITIONS:
            found = [
                errors for name, seed in towns
                for errors in compare(condition, name, int(seed), given.pairs, network)
            ]  # fmt: skip
            row: list[object] = [condition.name, len(found)]
            for kind in (0, 1):
                matches, within, metres, degrees = np.array([both[kind] for both in found]).T
                posed = (metres < 1.0) & (degrees < 3.0)
                row += [f"{np.median(matches):.0f}", f"{np.mean(within):.2f}",
                        f"{np.mean(posed):.2f}", f"{np.median(metres):.3f}",
                        f"{np.median(degrees):.2f}"]  # fmt: skip
            rows.writerow(row)
            file.flush()
            sys.stdout.write(" ".join(map(str, row)) + "\n")
            sys.stdout.flush()


if __name__ == "__main__":
    main()
