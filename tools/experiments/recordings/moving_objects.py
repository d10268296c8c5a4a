"""Measures tracking while large vehicles move in front of the camera, in rendered streets.

For each scene, the largest error of the pose at the time of tracking is reported, relative to the
first frame and without alignment.

    python tools/experiments/recordings/moving_objects.py --out families.csv
"""

from __future__ import annotations

import argparse
import csv
import re
import tempfile
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vslam import METHOD_VERSION
from vslam.slam import Slam
from vslam.types.camera import Camera, Image
from vslam.types.features import TrackingState
from vslam.types.geometry import inverse
from vslam_lab.towns.passes import Passes
from vslam_lab.towns.render import Renderer, sensor_image
from vslam_lab.towns.routes import CAMERA_HEIGHT, Route, built_in_route
from vslam_lab.towns.scene import Surfaces, join
from vslam_lab.towns.site import Variation
from vslam_lab.towns.solids import box, turn
from vslam_lab.towns.town import Town, build_town

STEP_S = 0.1
FRAMES = 80
ROUTE, PLACE = "demo", 25  # route, and index of the frame at which the scenes begin


@dataclass(frozen=True)
class Vehicle:
    """A box that moves in a straight line.

    Attributes:
        size: width, height and length in metres. The length is along the direction of motion.
        start: position of the middle of its rear, right and ahead of the first camera, in metres.
        heading: direction of motion in degrees, from straight ahead to the right.
        travelled: metres that it has moved after a given time in seconds.
    """

    size: tuple[float, float, float]
    start: tuple[float, float]
    heading: float
    travelled: Callable[[float], float]

    def surfaces(self, texture: int, T_wc: NDArray[np.float64], seconds: float) -> Surfaces:
        width, height, length = self.size
        body = box((-width / 2, -height, 0.0), (width / 2, -0.25, length), texture, thing=0)
        R = T_wc[:3, :3] @ turn(np.radians(self.heading))
        right, ahead = self.start
        at = T_wc[:3, :3] @ [right, CAMERA_HEIGHT, ahead] + T_wc[:3, 3]
        return body.moved(R, at + R[:, 2] * self.travelled(seconds))


@dataclass(frozen=True)
class Scene:
    """Vehicles, and the motion of the camera along the route: metres after a time in seconds."""

    vehicles: tuple[Vehicle, ...]
    travelled: Callable[[float], float] = lambda t: 0.0
    yaw: float = 0.0  # degrees by which the camera is turned to the right


def at_speed(speed: float, since: float = 0.0) -> Callable[[float], float]:
    return lambda t: speed * max(0.0, t - since)


def accelerating(acceleration: float, since: float, limit: float) -> Callable[[float], float]:
    """Metres after a start from rest at ``since``, up to a speed of ``limit``."""

    def travelled(t: float) -> float:
        t, full = max(0.0, t - since), limit / acceleration
        return 0.5 * acceleration * min(t, full) ** 2 + limit * max(0.0, t - full)

    return travelled


def crossing(height: float, pixels: float, distance: float, camera: Camera) -> Vehicle:
    """A lorry that crosses from the right, with a given motion in pixels per frame."""
    speed = pixels * distance / (camera.fx * STEP_S)
    right = camera.width / 2 * distance / camera.fx + 1.0
    return Vehicle((2.5, height, 14.0), (right + 14.0, distance), -90.0, at_speed(speed, 1.0))


def scenes(camera: Camera) -> dict[str, Scene]:
    found = {}
    for name, height, distance in (
        ("third", 2.0, 12.0),
        ("two_thirds", 3.2, 9.0),
        ("full", 5.0, 6.0),
    ):
        for pixels in (3.0, 6.0, 12.0, 20.0, 40.0):
            lorry = crossing(height, pixels, distance, camera)
            found[f"rest_{name}_{pixels:g}"] = Scene((lorry,))
            if pixels > 3.0:
                found[f"start_{name}_{pixels:g}"] = Scene((lorry,), accelerating(0.5, 2.0, 0.6))
    for gap in (5.0, 8.0):
        bus = Vehicle((2.5, 3.2, 12.0), (0.0, gap), 0.0, at_speed(8.0))
        found[f"follow_{gap:g}"] = Scene((bus,), at_speed(8.0))
        go = accelerating(1.0, 2.0, 8.0)
        bus = Vehicle((2.5, 3.2, 12.0), (0.0, gap), 0.0, go)
        found[f"behind_{gap:g}"] = Scene((bus,))
        found[f"follow_start_{gap:g}"] = Scene((bus,), accelerating(1.0, 3.0, 8.0))
    overtaking = Vehicle((2.5, 3.6, 14.0), (-3.2, -16.0), 0.0, at_speed(13.0))
    found["overtaken"] = Scene((overtaking,), at_speed(8.0))
    for speed in (6.0, 12.0):
        oncoming = Vehicle((2.5, 3.6, 14.0), (-3.2, 40.0), 180.0, at_speed(speed))
        found[f"oncoming_{speed:g}"] = Scene((oncoming,))
    for acceleration in (0.5, 1.5):
        go = [accelerating(acceleration, 2.0 + 0.4 * k, 8.0) for k in range(3)]
        cars = [
            Vehicle((1.8, 1.5, 4.4), (x, 4.0 + 6.5 * k + shift), 0.0, go[k])
            for x, shift in ((-3.0, -1.5), (0.0, 1.5), (3.0, 0.0))
            for k in range(3)
        ]
        found[f"queue_{acceleration:g}"] = Scene(tuple(cars))
        for height in (2.4, 3.4):
            train = Vehicle(
                (2.8, height, 70.0), (6.0, -30.0), 0.0, accelerating(acceleration, 2.0, 8.0)
            )
            found[f"train_{height:g}_{acceleration:g}"] = Scene((train,), yaw=50.0)
    return found


@dataclass(frozen=True)
class Drive:
    """The ``(N, H, W)`` left and right images of a scene, and the ``(N, 4, 4)`` true poses."""

    left: NDArray[np.uint8]
    right: NDArray[np.uint8]
    T_wc: NDArray[np.float64]

    def errors_cm(self, T_wc: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the ``(N,)`` errors of the positions relative to the first frame."""
        found, true = (inverse(T[0]) @ T for T in (T_wc, self.T_wc))
        errors: NDArray[np.float64] = np.linalg.norm(found[:, :3, 3] - true[:, :3, 3], axis=1)
        return 100.0 * errors


class Stage:
    """Renders the scenes in a street of a rendered town."""

    def __init__(self, seed: int) -> None:
        self.route: Route = built_in_route(ROUTE)
        self.variation = Variation(seed=seed)
        self.town: Town = build_town(self.route, self.variation)
        self.moment = Passes(self.route, self.town, self.variation).at(PLACE)
        walls = self.town.surfaces
        upright = np.abs(walls.edge_t) @ [1.0, 0.0, 1.0] < 1e-6
        wide = np.linalg.norm(walls.edge_s, axis=1) > 6.0
        side = walls.select(
            (walls.edge_t[:, 1] > 5.0)
            & upright
            & wide
            & (walls.material == 0)
            & (walls.layer == 0)
            & (walls.thing >= 0)
        )
        self.textures = np.unique(side.texture)
        along = np.linalg.norm(np.diff(self.route.T_wc[:, :3, 3], axis=0), axis=1)
        self.along = np.concatenate([[0.0], np.cumsum(along)])

    def pose(self, metres: float, yaw: float) -> NDArray[np.float64]:
        at = self.along[PLACE] + metres
        k = int(np.searchsorted(self.along, at, side="right")) - 1
        T_wc = self.route.T_wc[k].copy()
        share = (at - self.along[k]) / (self.along[k + 1] - self.along[k])
        T_wc[:3, 3] += share * (self.route.T_wc[k + 1, :3, 3] - T_wc[:3, 3])
        T_wc[:3, :3] = T_wc[:3, :3] @ turn(np.radians(yaw))
        return T_wc

    def frames(self, scene: Scene) -> Iterator[tuple[Image, Image, NDArray[np.float64]]]:
        """Yield the two images and the true pose ``T_wc`` of each frame."""
        first = self.pose(0.0, 0.0)
        with closing(Renderer(self.route.camera, self.town.atlas, self.town.sky, 2)) as renderer:
            for k in range(FRAMES):
                seconds = k * STEP_S
                bodies = [
                    one.surfaces(int(self.textures[j % len(self.textures)]), first, seconds)
                    for j, one in enumerate(scene.vehicles)
                ]
                surfaces = join([self.moment.surfaces, *bodies])
                T_wc = self.pose(scene.travelled(seconds), scene.yaw)
                views = renderer.stereo(replace(self.moment, surfaces=surfaces), T_wc)
                left, right = (
                    sensor_image(view.image, self.route.camera, yaw_rate=0.0, night=0.0,
                                 key=(self.variation.seed, k, side))
                    for side, view in enumerate(views)
                )  # fmt: skip
                yield left, right, T_wc


def rendered(stage: Stage, name: str, scene: Scene, cache: Path) -> Drive:
    """Render a scene, or read it from the folder ``cache``."""
    path = cache / f"{name}_{stage.variation.seed}.npz"
    if not path.exists():
        left, right, poses = zip(*stage.frames(scene), strict=True)
        np.savez(path, left=np.array(left), right=np.array(right), T=np.array(poses))
    with np.load(path) as data:
        return Drive(data["left"], data["right"], data["T"])


def measure(camera: Camera, drive: Drive) -> dict[str, float]:
    """Run SLAM on a scene."""
    slam = Slam(camera, detector="none")
    pairs = zip(drive.left, drive.right, strict=True)
    results = [slam.step(*pair, k * STEP_S) for k, pair in enumerate(pairs)]
    slam.finish()
    causal = drive.errors_cm(np.array([result.T_wc for result in results]))
    final = drive.errors_cm(slam.trajectory().T_wc)
    return {
        "largest_cm": round(float(causal.max()), 2),
        "final_cm": round(float(final.max()), 2),
        "lost": sum(result.state == TrackingState.LOST for result in results),
        "keyframes": sum(result.is_keyframe for result in results),
    }


def by_family(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the worst numbers of each family of scenes."""
    families: dict[str, list[dict[str, Any]]] = {}
    for row in rows:
        families.setdefault(re.split(r"_(?!start)", row["scene"])[0], []).append(row)
    worst = ("largest_cm", "final_cm", "lost", "keyframes")
    return [
        {"family": family, "method": METHOD_VERSION, "scenes": len(ours)}
        | {"within_2_cm": sum(row["largest_cm"] <= 2.0 for row in ours)}
        | {name: max(row[name] for row in ours) for name in worst}
        for family, ours in families.items()
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, help="CSV file of the families")
    parser.add_argument("--scenes", default=".", help="regular expression of the scenes")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1], help="towns")
    parser.add_argument("--cache", type=Path, help="folder that keeps the rendered scenes")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        cache = args.cache or Path(temporary)
        cache.mkdir(parents=True, exist_ok=True)
        rows = []
        for stage in map(Stage, args.seeds):
            for name, scene in scenes(stage.route.camera).items():
                if re.search(args.scenes, name):
                    drive = rendered(stage, name, scene, cache)
                    rows.append({"scene": name} | measure(stage.route.camera, drive))
                    print(stage.variation.seed, *rows[-1].values(), sep="\t", flush=True)
    with args.out.open("w", newline="") as file:
        families = by_family(rows)
        writer = csv.DictWriter(file, list(families[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(families)


if __name__ == "__main__":
    main()
