"""Explains why a run tracked no frame, by examining a few frames of the run."""

from __future__ import annotations

from itertools import islice

import numpy as np

from vslam.datasets.frames import Source
from vslam.doctor.checks import check_sides
from vslam.doctor.matching import joined, match_images
from vslam.errors import InputError, counted
from vslam.run.options import RunOptions
from vslam.run.outcome import RunOutcome

_FRAMES = 3  # they determine the sign of the disparity: each has hundreds of matches


def why_nothing_was_tracked(outcome: RunOutcome) -> str | None:
    """Explain in one sentence why no frame of a run was tracked, and what the user can do.

    The result is None if a frame was tracked.
    """
    n, options = len(outcome.tracks), outcome.settings
    if n == 0 or outcome.n_tracked:
        return None
    problem = f"nothing was tracked in {counted(n, 'frame')}"
    if len(outcome.skipped) == n:
        return f"{problem}: no image could be read ({outcome.skipped[0].rstrip('.')})"
    if options.localize:
        return f"{problem}: no frame was recognised in the map {options.map_file}"
    if outcome.sequence.camera.sensor == "stereo" and not outcome.sequence.live:
        disparity = _negative_disparity(outcome.sequence)
        if disparity is not None:
            fix = how_to_swap(outcome.sequence.dataset, options)
            return (
                f"{problem}: disparities are negative (median {disparity:.1f} px), as if left and "
                f"right were swapped; {fix}"
            )
    if options.perturb != "none":
        return f"{problem} under --perturb {options.perturb}; a weaker perturbation may work"
    if outcome.sequence.camera.monocular:
        return (
            f"{problem}: a single camera must move sideways to begin a map; if it did, vslam "
            "doctor checks images, calibration and times"
        )
    return f"{problem}: vslam doctor checks images, calibration and times"


def _negative_disparity(source: Source) -> float | None:
    """Return the median disparity (px) of a few frames if left and right seem to be swapped."""
    found = []
    try:
        for frame in islice(source.frames(), _FRAMES):
            left, right = frame.read(map)
            found.append(match_images(left, np.asarray(right, np.uint8)))
    except InputError:  # a damaged image; the frames before it are enough
        pass
    if not any(map(len, found)):
        return None
    matches = joined(found)
    middle = float(np.median(matches.left[:, 0] - matches.right[:, 0]))
    swapped = middle < 0 and check_sides(matches).verdict == "fault"
    return middle if swapped else None


def how_to_swap(dataset: str, options: RunOptions) -> str:
    """Tell the user how to swap the left and the right images."""
    if dataset == "images" and options.right is not None:
        return f"swap them: --data {options.right} --right {options.data}"
    if dataset == "images":
        return "swap the folders of the left and the right images"
    if dataset == "bag" and options.topics:
        return f"swap them: --topics {','.join(reversed(options.topics.split(',')))}"
    if dataset == "bag":
        return "give both topics with --topics, that of the left images first"
    if dataset == "video":
        return "swap the halves of the images: the left camera's half must be on the left"
    folders = {
        "kitti": "image_0 and image_1",
        "kitti_raw": "image_00 and image_01",
        "euroc": "cam0 and cam1",
    }
    return f"swap {folders.get(dataset, 'the images of both cameras')}"
