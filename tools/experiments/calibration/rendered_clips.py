"""Measure how well `--calib auto` knows the focal length of rendered clips, and its own error.

    python tools/experiments/calibration/rendered_clips.py --seeds 500-599 --out clips.csv

Each clip has another path, field of view (45 to 100 degrees) and radial distortion (half of the
clips have none). ``error`` is the relative error of the focal length, ``sigma`` its stated standard
deviation. ``told`` is 0 if the clip was refused, and ``within`` 1 if the error is at most two
standard deviations. Seeds below 500 were used for tuning. Rows are added to a file that exists, and
the clips that it has are left out, so that a run that was cut off can be continued.
"""

from __future__ import annotations

import argparse
import csv
import os
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as in a run; idle threads burn CPU time

import cv2
import numpy as np

from vslam.calibration.from_motion import camera_from_motion
from vslam.calibration.models import CameraModel, unproject
from vslam.support.errors import InputError
from vslam.types.camera import Camera, Image
from vslam_lab.towns import Variation, route_named
from vslam_lab.towns.passes import Passes
from vslam_lab.towns.render import Renderer, sensor_image
from vslam_lab.towns.rooms import SIZES, build_room
from vslam_lab.towns.town import build_town

FAMILIES = ("room", "walk", "hall", "drone", "demo")
SIZE = (384, 288)
FRAMES = 80


def camera_of(seed: int) -> CameraModel:
    rng = np.random.default_rng([seed, 72])
    focal = SIZE[0] / 2.0 / np.tan(np.radians(rng.uniform(45.0, 100.0)) / 2.0)
    corner = float(np.hypot(*SIZE)) / 2.0 / focal
    k1 = rng.uniform(-0.15, 0.1) / max(corner, 1.0) ** 2 if rng.uniform() < 0.5 else 0.0
    centre = (SIZE[0] - 1) / 2.0, (SIZE[1] - 1) / 2.0
    return CameraModel(focal, focal, *centre, *SIZE, "pinhole", (k1, 0.0, 0.0, 0.0))


def wide_camera(model: CameraModel, rays: np.ndarray) -> Camera:
    """Return the pinhole camera of which an image shows all rays."""
    reach = np.abs(rays[..., :2] / rays[..., 2:]).reshape(-1, 2).max(axis=0)
    width, height = (2 * np.ceil(model.fx * reach) + 5).astype(int).tolist()
    return Camera(model.fx, model.fy, (width - 1) / 2, (height - 1) / 2, 0.0, width, height)


def clip(family: str, seed: int, model: CameraModel) -> Iterator[tuple[float, Image]]:
    u, v = np.meshgrid(np.arange(model.width), np.arange(model.height))
    rays = unproject(model, np.stack([u, v], axis=-1).reshape(-1, 2).astype(float))
    rays = rays.reshape(model.height, model.width, 3)
    camera = wide_camera(model, rays)
    x = (camera.fx * rays[..., 0] / rays[..., 2] + camera.cx).astype(np.float32)
    y = (camera.fy * rays[..., 1] / rays[..., 2] + camera.cy).astype(np.float32)
    variation = Variation(seed)
    route = replace(route_named(family, variation), camera=camera)
    inside = route.land in SIZES
    town = build_room(route.land, variation) if inside else build_town(route, variation)
    passes = Passes(route, town, variation)
    start = 60 if family in ("hall", "drone") else 20
    every = 1 if family == "demo" else 2
    with closing(Renderer(camera, town.atlas, town.sky)) as renderer:
        for k in range(start, min(start + every * FRAMES, len(route.T_wc)), every):
            moment = passes.at(k)
            (view,) = renderer.views(moment, route.T_wc[k])
            image = sensor_image(
                view.image, camera, yaw_rate=float(route.yaw_rate[k]),
                pitch_rate=float(route.pitch_rate[k]), night=moment.night, key=(seed, k, 0),
            )  # fmt: skip
            yield k / route.rate, np.asarray(cv2.remap(image, x, y, cv2.INTER_CUBIC), np.uint8)


FIELDS = (
    "clip", "family", "focal", "k1", "told", "within", "off_percent", "found", "error", "sigma",
    "chains", "lens", "read_out", "refused",
)  # fmt: skip


def row_of(seed: int) -> dict[str, object]:
    """Calibrate one clip. Values that a refused clip does not have are left out."""
    family, model = FAMILIES[seed % len(FAMILIES)], camera_of(seed)
    row: dict[str, object] = {
        "clip": f"{family}+seed:{seed}",
        "family": family,
        "focal": round(float(model.fx), 1),
        "k1": round(float(model.distortion[0]), 3),
    }
    try:
        fit = camera_from_motion(clip(family, seed, model), SIZE, "clip")
    except InputError as refusal:
        return row | {"told": 0, "refused": str(refusal).partition(": ")[2].partition(", so")[0]}
    error = float(fit.camera.fx / model.fx - 1.0)
    return row | {
        "told": 1,
        "within": int(abs(error) <= 2.0 * fit.sigma),
        "off_percent": round(100.0 * abs(error), 2),
        "found": round(fit.camera.fx, 1),
        "error": round(error, 4),
        "sigma": round(fit.sigma, 4),
        "chains": fit.chains,
        "lens": fit.camera.lens,
        "read_out": round(fit.read_out, 2),
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--seeds", nargs="+", required=True, help="ranges, such as 500-519")
    parser.add_argument("--out", type=Path, required=True, help="CSV file to write")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    known = set()
    if args.out.exists():
        with args.out.open(newline="") as file:
            known = {row["clip"].partition(":")[2] for row in csv.DictReader(file)}
    with args.out.open("a", newline="") as file:
        writer = csv.DictWriter(file, FIELDS, lineterminator="\n")
        if file.tell() == 0:
            writer.writeheader()
        for part in args.seeds:
            first, *last = (int(end) for end in part.split("-"))
            for seed in range(first, (last or [first])[0] + 1):
                if str(seed) not in known:
                    row = row_of(seed)
                    writer.writerow(row)
                    file.flush()
                    print(row, flush=True)


if __name__ == "__main__":
    main()
