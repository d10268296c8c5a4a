"""Rendered sequences as an RGB-D camera sees them, in TUM's layout (`vslam.datasets.tum`)."""

from __future__ import annotations

import shutil
from pathlib import Path

import yaml

from vslam.camera import Camera
from vslam.datasets.synthetic.files import frame_files, write, writing
from vslam.datasets.synthetic.routes import Route
from vslam.datasets.synthetic.site import Variation
from vslam.datasets.synthetic.store import DEPTH_SCALE, OnFrame, render_sequence
from vslam.datasets.tum import CALIBRATION
from vslam.trajectory import Trajectory, write_tum


def render_rgbd(
    route: Route,
    variation: Variation,
    out: Path,
    *,
    until: int | None = None,
    threads: int = 2,
    on_frame: OnFrame | None = None,
) -> Path:
    """Render a route, or its missing frames, into a folder and return the folder.

    ``out/stereo`` has the same drive as a KITTI tree. The left image serves as colour image. Depth
    has no maximum range; it is in centimetres, 0 in the sky. The virtual baseline in
    ``calibration.yaml`` is the baseline of the rendered pair, so that far points are as uncertain
    as with stereo.

    Args:
        route, variation, threads, on_frame: as for `render_sequence`.
        out: output folder.
        until: write only the frames before this one.

    Raises:
        InputError: as `render_sequence`, or the folder cannot be written.
    """
    root = render_sequence(
        route,
        variation,
        out / "stereo",
        depth=True,
        until=until,
        threads=threads,
        on_frame=on_frame,
    )
    n = min(until or len(route.T_wc), len(route.T_wc))
    source = root / "sequences" / route.name
    with writing(out):
        names: dict[str, list[str]] = {"rgb": [], "depth": []}
        for kind in names:
            (out / kind).mkdir(parents=True, exist_ok=True)
        for k, time in enumerate(route.timestamps[:n].tolist()):
            left, _, depth = frame_files(source, k, True)
            for kind, path in (("rgb", left), ("depth", depth)):
                name = f"{kind}/{time:.6f}.png"
                shutil.copyfile(path, out / name)
                names[kind].append(f"{time:.6f} {name}\n")
        for kind, lines in names.items():
            write(out / f"{kind}.txt", "".join(["# timestamp filename\n", *lines]).encode())
        truth = Trajectory(route.timestamps[:n], route.ground_truth[:n])
        write_tum(out / "groundtruth.txt", truth)
        write(out / CALIBRATION, _calibration(route.camera).encode())
    return out


def _calibration(camera: Camera) -> str:
    left = {
        "lens": "pinhole",
        "size": [camera.width, camera.height],
        "focal": [camera.fx, camera.fy],
        "centre": [camera.cx, camera.cy],
    }
    return yaml.safe_dump(
        {"left": left, "depth_scale": DEPTH_SCALE, "virtual_baseline": camera.baseline}
    )
