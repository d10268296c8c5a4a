"""Explaining why a run tracked nothing, from a few of its frames."""

from __future__ import annotations

from itertools import islice

import numpy as np

from vslam.datasets.frames import Source
from vslam.doctor.checks import check_sides
from vslam.doctor.matching import joined, match_images
from vslam.errors import InputError, counted
from vslam.run.options import RunOptions
from vslam.run.outcome import RunOutcome

_FRAMES = 3  # examined frames; each shows the sign of hundreds of disparities


def why_nothing_was_tracked(outcome: RunOutcome) -> str | None:
    """One sentence that explains why no frame of a run was tracked and what to do; None if a frame
    was tracked."""
    n, options = len(outcome.tracks), outcome.settings
    if n == 0 or outcome.n_tracked:
        return None
    said = f"nothing was tracked in {counted(n, 'frame')}"
    if len(outcome.skipped) == n:
        return f"{said}: no image could be read ({outcome.skipped[0].rstrip('.')})"
    if options.localize:
        return f"{said}: none of them was recognised in the map {options.map_file}"
    if outcome.sequence.camera.sensor == "stereo" and not outcome.sequence.live:
        middle = _median_disparity_behind_infinity(outcome.sequence)
        if middle is not None:
            how = how_to_swap(outcome.sequence.dataset, options)
            return (
                f"{said}: disparities are negative (median {middle:.1f} px), as if left and right "
                f"were swapped; {how}"
            )
    if options.perturb != "none":
        return f"{said} under --perturb {options.perturb}; a weaker one may work"
    if outcome.sequence.camera.monocular:
        return f"{said}: one camera must move sideways to begin a map; vslam doctor checks the rest"
    return f"{said}: vslam doctor says what is wrong with images, calibration or times"


def _median_disparity_behind_infinity(source: Source) -> float | None:
    """Median disparity of a few frames in pixels if the sides seem to be swapped, else None."""
    found = []
    try:
        for frame in islice(source.frames(), _FRAMES):
            left, right = frame.read(map)
            found.append(match_images(left, np.asarray(right, np.uint8)))
    except InputError:  # a damaged image; those before it will do
        pass
    if not any(map(len, found)):
        return None
    matches = joined(found)
    middle = float(np.median(matches.left[:, 0] - matches.right[:, 0]))
    swapped = middle < 0 and check_sides(matches).verdict == "fault"
    return middle if swapped else None


def how_to_swap(dataset: str, options: RunOptions) -> str:
    """Options that swap the two sides, or what to exchange if no option does."""
    if dataset == "images" and options.right is not None:
        return f"exchange them: --data {options.right} --right {options.data}"
    if dataset == "images":
        return "name the folders the other way round with --data and --right"
    if dataset == "bag" and options.topics:
        return f"exchange them: --topics {','.join(reversed(options.topics.split(',')))}"
    if dataset == "bag":
        return "name the topics the other way round with --topics"
    if dataset == "video":
        return "exchange the halves of the images: the left camera's must be on the left"
    folders = {"kitti": "image_0 and image_1", "euroc": "cam0 and cam1"}
    return f"exchange {folders.get(dataset, 'the images of both cameras')}"
