"""Rendered sequences in KITTI's format, in the user's cache.

An interrupted rendering is resumed by the next call.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import shutil
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vslam.support.errors import counted
from vslam.types.camera import Camera
from vslam.types.trajectory import write_kitti
from vslam_lab.towns.files import (
    check_disk,
    checksum,
    damaged_frames,
    frame_files,
    lock_of,
    size,
    write,
    write_png,
    writing,
)
from vslam_lab.towns.passes import Passes
from vslam_lab.towns.render import Renderer, sensor_image
from vslam_lab.towns.rooms import SIZES, build_room
from vslam_lab.towns.routes import Route
from vslam_lab.towns.site import Variation
from vslam_lab.towns.town import build_town

VERSION = 2  # must be increased whenever the same seed produces different images
DEPTH_SCALE = 100.0  # 16-bit depth images are in centimetres
_RECORD = "manifest.json"

_log = logging.getLogger(__name__)

OnFrame = Callable[[int, int], None]


@dataclass(frozen=True)
class Stored:
    """A rendered sequence in a cache folder.

    Attributes:
        root: folder with the sequence in KITTI's format.
        name: name of the sequence in that folder.
        frames: number of frames of the sequence.
        complete: whether all frames are rendered.
        size: size on the disk in bytes.
    """

    root: Path
    name: str
    frames: int
    complete: bool
    size: int


def cache_folder() -> Path:
    """Return the folder of rendered sequences, in ``$VSLAM_CACHE`` or in the user's cache."""
    from platformdirs import user_cache_path

    return Path(os.environ.get("VSLAM_CACHE") or user_cache_path("vslam")) / "synthetic"


def folder_name(variation: Variation) -> str:
    """Return the name of the folder of all sequences whose towns have this variation."""
    name = f"v{VERSION}-seed{variation.seed}"
    name += "-aliased" if variation.aliased else ""
    name += f"-moving{variation.moving}" if variation.moving else ""
    return name + (f"-change{variation.change:g}" if variation.change else "")


def list_stored(cache: Path) -> list[Stored]:
    """List all rendered sequences in a cache folder. Some of them may be incomplete."""
    found = []
    for record in sorted(cache.glob(f"*/sequences/*/{_RECORD}")):
        folder, root = record.parent, record.parents[2]
        if manifest := _read_record(folder):
            frames, complete = int(manifest["route"]["frames"]), "checksums" in manifest
            found.append(Stored(root, folder.name, frames, complete, _folder_size(folder)))
    return found


def _folder_size(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def place_folder(cache: Path) -> Path:
    """Return the folder of the images that the benchmark of loop detectors renders."""
    return cache / f"v{VERSION}-places"


def clean(cache: Path, name: str | None = None) -> int:
    """Remove the whole cache, or all variations of the route ``name``. Return the freed bytes."""
    freed = 0
    for places in cache.glob("v*-places") if name is None else []:
        freed += _folder_size(places)
        shutil.rmtree(places)
    for stored in list_stored(cache):
        if name in (None, stored.name):
            freed += stored.size
            shutil.rmtree(stored.root / "sequences" / stored.name)
            (stored.root / "poses" / f"{stored.name}.txt").unlink(missing_ok=True)
    return freed


def render_sequence(
    route: Route,
    variation: Variation,
    cache: Path,
    *,
    depth: bool = False,
    until: int | None = None,
    verify: bool = False,
    threads: int = 2,
    on_frame: OnFrame | None = None,
) -> Path:
    """Render the missing frames of a route in KITTI's format. Return the folder of the data set.

    Damaged frames are rendered again, and a warning is logged. While another process renders the
    sequence, this one waits.

    Args:
        variation: variation of the town.
        cache: folder of the rendered sequences (`cache_folder`).
        depth: whether to write ``depth_0``, too. It contains the depth of the left camera in
            centimetres, as 16-bit PNG files.
        until: number of the frame before which rendering ends. A later call can continue from
            there.
        verify: whether the checksums of all existing frames are checked. Otherwise, all file sizes
            and a few checksums are checked.
        threads: number of frames that are rendered in parallel. The images do not depend on it.
        on_frame: called with the number of finished frames and the number of all frames.

    Raises:
        InputError: the folder cannot be written, or the disk is too small.
    """
    root = cache / folder_name(variation)
    folder = root / "sequences" / route.name
    wanted = _record_of(route, variation, depth)
    frames = len(route.T_wc)
    n = min(until or frames, frames)
    found, missing = _look(folder, wanted, route.camera, n, verify)
    if _is_complete(found) and not missing:
        return root
    check_disk(cache, len(missing), depth)
    with writing(cache), lock_of(folder):
        # Another process may have rendered the sequence while this one waited for the lock.
        found, missing = _look(folder, wanted, route.camera, n, verify)
        if _is_complete(found):
            if not missing:
                return root
            numbers = ", ".join(map(str, missing[:5])) + (", ..." if len(missing) > 5 else "")
            count = counted(len(missing), "damaged frame")
            _log.warning("%s: rendering %s again: %s", folder, count, numbers)
            n = frames
        if found is None and folder.exists():
            shutil.rmtree(folder)
        for name in ("image_0", "image_1", *(("depth_0",) if depth else ())):
            (folder / name).mkdir(parents=True, exist_ok=True)
        write(folder / _RECORD, json.dumps(wanted).encode())
        write(folder / "times.txt", "".join(f"{t:.6e}\n" for t in route.timestamps).encode())
        write(folder / "calib.txt", calibration_text(route.camera).encode())
        (root / "poses").mkdir(exist_ok=True)
        write_kitti(root / "poses" / f"{route.name}.txt", route.ground_truth)
        for k in missing:
            for path in frame_files(folder, k, depth):
                path.unlink(missing_ok=True)
        if missing:
            render_frames(
                route, variation, folder, missing, depth, threads, on_frame, total=missing[-1] + 1
            )
        if n < frames:
            return root
        files = [frame_files(folder, k, depth) for k in range(n)]
        sums = {"checksums": [checksum(f) for f in files], "sizes": [size(f) for f in files]}
        write(folder / _RECORD, json.dumps({**wanted, **sums}).encode())
    return root


def _matching_record(folder: Path, wanted: dict[str, Any], camera: Camera) -> dict[str, Any] | None:
    found = _read_record(folder)
    if found is None or any(found.get(key) != value for key, value in wanted.items()):
        return None
    try:
        same = (folder / "calib.txt").read_text() == calibration_text(camera)
    except FileNotFoundError:
        same = True
    return found if same else None


def _is_complete(record: dict[str, Any] | None) -> bool:
    return record is not None and "checksums" in record


def _look(
    folder: Path, wanted: dict[str, Any], camera: Camera, n: int, verify: bool
) -> tuple[dict[str, Any] | None, list[int]]:
    """Return the record of a matching sequence, if there is one, and the frames to render."""
    record = _matching_record(folder, wanted, camera)
    if record is None:
        return None, list(range(n))
    if _is_complete(record):
        return record, damaged_frames(folder, record, thorough=verify)
    frames = [frame_files(folder, k, record["depth"]) for k in range(n)]
    return record, [k for k, paths in enumerate(frames) if not all(p.exists() for p in paths)]


def render_frames(
    route: Route,
    variation: Variation,
    folder: Path,
    frames: list[int],
    depth: bool,
    threads: int,
    on_frame: OnFrame | None,
    *,
    total: int,
    monocular: bool = False,
) -> None:
    """Render frames of a route into the folder of a sequence.

    Args:
        threads: number of frames that are rendered in parallel.
        on_frame: called with the number of finished frames and ``total``.
        total: number of frames of the sequence. Frames that are not rendered count as finished.
        monocular: render only the left images.
    """
    inside = route.land in SIZES
    town = build_room(route.land, variation) if inside else build_town(route, variation)
    passes = Passes(route, town, variation)
    renderer = Renderer(route.camera, town.atlas, town.sky, threads)
    yaw_rate, pitch_rate = route.yaw_rate, route.pitch_rate

    def render(k: int) -> None:
        moment, T_wc = passes.at(k), route.T_wc[k]
        views = renderer.views(moment, T_wc) if monocular else renderer.stereo(moment, T_wc)
        paths = frame_files(folder, k, depth)
        for side, (view, path) in enumerate(zip(views, paths, strict=False)):
            image = sensor_image(
                view.image,
                route.camera,
                yaw_rate=float(yaw_rate[k]),
                pitch_rate=float(pitch_rate[k]),
                night=moment.night,
                key=(variation.seed, k, side),
            )
            write_png(path, image, 1)
        if depth:
            centimetres = np.clip(np.rint(views[0].depth * DEPTH_SCALE), 0, 65535)
            write_png(paths[2], centimetres.astype(np.uint16), 1)

    with closing(renderer), ThreadPoolExecutor(threads) as pool:
        try:
            for done, _ in enumerate(pool.map(render, frames), total - len(frames) + 1):
                if on_frame:
                    on_frame(done, total)
        finally:
            pool.shutdown(cancel_futures=True)


def _record_of(route: Route, variation: Variation, depth: bool) -> dict[str, Any]:
    poses_sha256 = hashlib.sha256(route.T_wc.tobytes()).hexdigest()
    return {
        "version": VERSION,
        "variation": asdict(variation),
        "depth": depth,
        "route": {"name": route.name, "frames": len(route.T_wc), "poses_sha256": poses_sha256},
    }


def _read_record(folder: Path) -> dict[str, Any] | None:
    try:
        record = json.loads((folder / _RECORD).read_text())
        return record if isinstance(record, dict) else None
    except (OSError, ValueError):
        return None


def calibration_text(camera: Camera) -> str:
    """Return KITTI's ``calib.txt``. Colour and grey cameras have the same calibration."""
    lines = []
    for side in range(4):
        shift = -camera.bf if side % 2 else 0.0
        numbers = [camera.fx, 0, camera.cx, shift, 0, camera.fy, camera.cy, 0, 0, 0, 1, 0]
        lines.append(f"P{side}: " + " ".join(f"{x:.12e}" for x in numbers) + "\n")
    return "".join(lines)
