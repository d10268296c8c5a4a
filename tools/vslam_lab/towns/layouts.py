"""Rendered sequences in other formats: RGB-D in TUM's layout, or a video."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import yaml

from vslam.calibration.files import CALIBRATION
from vslam.datasets.frames import Source
from vslam.support.errors import InputError
from vslam.types.camera import Camera
from vslam.types.trajectory import Trajectory, write_tum
from vslam_lab.towns.files import frame_files, write, writing
from vslam_lab.towns.routes import Route
from vslam_lab.towns.site import Variation
from vslam_lab.towns.store import DEPTH_SCALE, OnFrame, render_sequence


def render_rgbd(
    route: Route,
    variation: Variation,
    out: Path,
    *,
    until: int | None = None,
    threads: int = 2,
    on_frame: OnFrame | None = None,
) -> Path:
    """Render the missing frames of a route for an RGB-D camera, in TUM's layout.

    ``out/stereo`` contains the same drive in KITTI's format. The left image is used as the colour
    image. The depth is in centimetres, without a maximum range. It is 0 in the sky. The virtual
    baseline in ``calibration.yaml`` is the baseline of the rendered stereo pair, so that distant
    points have the same uncertainty as with stereo.

    Args:
        route, variation, threads, on_frame: same meaning as for `render_sequence`.
        out: output folder.
        until: number of the frame before which rendering ends.

    Returns:
        ``out``.

    Raises:
        InputError: the folder cannot be written, the disk is too small, or another process is
            rendering the sequence.
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
        write(out / CALIBRATION, _depth_calibration(route.camera).encode())
    return out


def _depth_calibration(camera: Camera) -> str:
    left = {
        "lens": "pinhole",
        "size": [camera.width, camera.height],
        "focal": [camera.fx, camera.fy],
        "centre": [camera.cx, camera.cy],
    }
    return yaml.safe_dump(
        {"left": left, "depth_scale": DEPTH_SCALE, "virtual_baseline": camera.baseline}
    )


def write_side_by_side(sequence: Source, path: Path) -> Path:
    """Write a stereo sequence as a lossless video (FFV1), and write its calibration to a file.

    Args:
        sequence: a stereo sequence. Its mean frame rate becomes the frame rate of the video.
        path: path of the video, for example with the suffix ``.mkv``.

    Returns:
        The calibration file: the path of the video with the suffix ``.yaml``.

    Raises:
        InputError: a file cannot be written.
    """
    import cv2

    camera, times = sequence.camera, sequence.timestamps
    seconds = float(times[-1] - times[0])
    fps = (len(times) - 1) / seconds if seconds > 0 else 10.0
    calibration = path.with_suffix(".yaml")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        calibration.write_text(_pair_calibration(camera))
    except OSError as error:
        raise InputError(
            f"{calibration}: cannot be written ({error.strerror}); give another file."
        ) from error
    size = (2 * camera.width, camera.height)
    fourcc = cv2.VideoWriter.fourcc(*"FFV1")
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, fourcc, fps, size, isColor=False)
    if not writer.isOpened():
        raise InputError(f"{path}: cannot be written as a video; give a file like town.mkv.")
    try:
        for index in range(len(sequence)):
            left, right = sequence.read(index)
            if right is None:
                raise InputError(f"{path}: a side-by-side video needs a stereo sequence.")
            writer.write(np.hstack([left, right]))
    finally:
        writer.release()
    return calibration


def _pair_calibration(camera: Camera) -> str:
    side = (
        f"{{size: [{camera.width}, {camera.height}], focal: [{camera.fx!r}, {camera.fy!r}], "
        f"centre: [{camera.cx!r}, {camera.cy!r}]}}"
    )
    return f"left: {side}\nright: {side}\nbaseline: {camera.baseline!r}\n"
