"""Labelled pairs of views for training loop detectors."""

from __future__ import annotations

import csv
import io
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vslam.datasets.synthetic import solids
from vslam.datasets.synthetic.camera_effects import sensor_image
from vslam.datasets.synthetic.passes import Passes
from vslam.datasets.synthetic.render import Renderer
from vslam.datasets.synthetic.routes import Route
from vslam.datasets.synthetic.site import Variation
from vslam.datasets.synthetic.store import OnFrame, check_disk, write_png, writing
from vslam.datasets.synthetic.town import build_town

_LATERAL, _HEADING, _HEIGHT = 1.4, 14.0, 0.25  # largest changes: m, degrees, m
_APART = 40.0  # m between different places


def render_pairs(
    route: Route,
    variation: Variation,
    folder: Path,
    count: int,
    *,
    threads: int = 2,
    on_frame: OnFrame | None = None,
) -> None:
    """Render ``count`` pairs, half of one place and half of two places that look alike.

    ``folder/pairs.csv`` has a row for each: both images, ``same`` (1 or 0) and how the second
    view differs (metres to the side, degrees, metres up, the moment of each view as a frame).

    Args:
        route: drive to take places from.
        variation: of the town; ``aliased`` makes different places look most alike, ``change``
            puts days between the views of one place.
        folder: to write to.
        count: number of pairs.
        threads: of the renderer.
        on_frame: called with pairs done and in all.

    Raises:
        InputError: the folder cannot be written or the disk is too small.
    """
    check_disk(folder, count, depth=False)
    rng = np.random.default_rng([variation.seed, 20])
    town = build_town(route, variation)
    passes = Passes(route, town, variation)
    renderer = Renderer(route.camera, town.atlas, town.sky, threads)
    places = route.T_wc[:, [0, 2], 3]
    last = len(places) - 1
    table = io.StringIO()
    rows = csv.writer(table)
    rows.writerow(["a", "b", "same", "lateral_m", "heading_deg", "height_m", "when_a", "when_b"])
    with writing(folder):
        (folder / "images").mkdir(parents=True, exist_ok=True)
        for k in range(count):
            same = k % 2 == 0
            first = int(rng.integers(len(places)))
            second = first
            if not same:
                apart = np.flatnonzero(np.linalg.norm(places - places[first], axis=1) > _APART)
                second = int(rng.choice(apart)) if apart.size else last - first
            shift = rng.uniform(-1, 1, 3) * [_LATERAL, _HEADING, _HEIGHT]
            whens = (first, last if same and variation.change > 0 else second)
            names = []
            for eye, (frame, when) in enumerate(zip((first, second), whens, strict=True)):
                T = route.T_wc[frame]
                T = T if eye == 0 else _shifted(T, *shift.tolist())
                moment = passes.at(when)
                view, _ = renderer.stereo(
                    moment.surfaces, moment.shadows, moment.light, T, moment.pools
                )
                image = sensor_image(view.image, route.camera, yaw_rate=0.0, night=moment.night,
                                     key=(variation.seed, k, eye))  # fmt: skip
                names.append(f"images/{k:06d}_{'ab'[eye]}.png")
                write_png(folder / names[-1], image, 1)
            rows.writerow([*names, int(same), *(f"{x:.3f}" for x in shift), *whens])
            if on_frame:
                on_frame(k + 1, count)
        (folder / "pairs.csv").write_text(table.getvalue())
    renderer.close()


def _shifted(
    T_wc: NDArray[np.float64], lateral: float, heading: float, height: float
) -> NDArray[np.float64]:
    moved = T_wc.copy()
    moved[:3, :3] = solids.turn(np.radians(heading)) @ T_wc[:3, :3]
    moved[:3, 3] += lateral * T_wc[:3, 0] + [0.0, -height, 0.0]
    return moved
