"""The version of the method changes whenever the trajectory of a reference clip changes.

There are three reference clips: a stereo corridor, the same corridor as RGB-D, and a drive round a
block whose loop is closed by night. After a change of the method, raise ``METHOD_VERSION`` in
``vslam/method/version.py`` and write the references again with ``make method``.
"""

from __future__ import annotations

import os
import platform
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import corridor_depth
from numpy.typing import NDArray

from vslam import METHOD_VERSION, Slam
from vslam.types.camera import Camera

REFERENCES = Path(__file__).parents[1] / "method_references.npz"
WRITE = "WRITE_METHOD_REFERENCES"  # environment variable
# Processors of one kind with other vector units differ by less than the first limit. Without fused
# multiplication, the night moves by 8e-5 m.
LIMIT_M, LIMIT_ELSEWHERE_M = 1e-6, 1e-3
Clip = tuple[Camera, Iterator[tuple[NDArray, NDArray, float]]]


@pytest.fixture
def clips(request: pytest.FixtureRequest) -> dict[str, Callable[[], Clip]]:
    """Return the camera and the frames of each reference clip by its name.

    A clip is rendered only when it is requested.
    """

    def stereo() -> Clip:
        corridor = request.getfixturevalue("corridor")
        return corridor.camera, zip(corridor.left, corridor.right, corridor.timestamps, strict=True)

    def depth() -> Clip:
        corridor = request.getfixturevalue("corridor")
        camera = replace(corridor.camera, depth=True)
        depths = (corridor_depth(camera, T_wc).astype(np.float32) for T_wc in corridor.T_wc)
        return camera, zip(corridor.left, depths, corridor.timestamps, strict=True)

    def night() -> Clip:
        block = request.getfixturevalue("round_the_block")
        return block.camera, ((*block.read(k), t) for k, t in enumerate(block.timestamps))

    return {"stereo": stereo, "rgbd": depth, "night": night}


def positions(clip: Clip) -> NDArray[np.float64]:
    """Return the final ``(N, 3)`` positions of the camera in metres, with the default detector."""
    camera, frames = clip
    slam = Slam(camera)
    for left, second, timestamp in frames:
        slam.step(left, second, timestamp)
    slam.finish()
    return slam.trajectory().T_wc[:, :3, 3]


@pytest.mark.parametrize("name", ["stereo", "rgbd", pytest.param("night", marks=pytest.mark.slow)])
def test_the_version_of_the_method_is_that_of_its_trajectories(name, clips):
    found = positions(clips[name]())
    references = dict(np.load(REFERENCES)) if REFERENCES.exists() else {}
    here = f"{platform.system()} {platform.machine()}"
    if os.environ.get(WRITE):
        references |= {name: found, "version": np.array(METHOD_VERSION), "made_on": np.array(here)}
        np.savez_compressed(REFERENCES, **references)
    far = moved(found, references[name])
    limit = LIMIT_M if references["made_on"] == here else LIMIT_ELSEWHERE_M
    assert references["version"] == METHOD_VERSION, "run make method"
    assert far < limit, (
        f"the clip {name} moved by {far:.2g} m: raise METHOD_VERSION in vslam/method/version.py, "
        "then run make method"
    )


def moved(found: NDArray[np.float64], reference: NDArray[np.float64]) -> float:
    """Return the largest distance between two trajectories in metres.

    It is infinite if the trajectories differ in length.
    """
    if found.shape != reference.shape:
        return np.inf
    return float(np.linalg.norm(found - reference, axis=1).max())
