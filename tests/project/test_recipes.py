"""The recipes of docs/howto/python.md run one after the other, as a reader would type them."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import StereoSequence, corridor_depth

from vslam import Slam
from vslam.types.loops import LoopEdge
from vslam.types.trajectory import read_trajectory

PAGE = Path(__file__).parents[2] / "docs/howto/python.md"
SECTION = re.compile(r"^## (.*?)\n(.*?)(?=^## |\Z)", re.DOTALL | re.MULTILINE)
CODE = re.compile(r"```python\n(.*?)```", re.DOTALL)
RECIPES = {
    title: "\n".join(CODE.findall(text))
    for title, text in SECTION.findall(PAGE.read_text())
    if "```python" in text
}


@pytest.fixture(scope="module")
def after(corridor: StereoSequence, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """The variables of a program after each recipe, by the title of the recipe."""
    c = corridor
    depths = [corridor_depth(c.camera, T).astype(np.float32) for T in c.T_wc]
    values: dict[str, Any] = {
        "frames": list(zip(c.left, c.right, c.timestamps, strict=True)),
        "inertial_frames": [
            (left, right, timestamp, np.zeros((0, 7)))
            for left, right, timestamp in zip(c.left, c.right, c.timestamps, strict=True)
        ],
        "depth_frames": list(zip(c.left, depths, c.timestamps, strict=True)),
    }
    held = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("recipes"))
        for title, code in RECIPES.items():
            exec(compile(code, f"{PAGE.name}: {title}", "exec"), values)
            held[title] = dict(values)
        held["file"] = read_trajectory("trajectory.tum")
    return held


@pytest.mark.parametrize("title", [title for title in RECIPES if title != "Change thresholds"])
def test_recipes_build_maps_and_report_no_problem(after, title):
    slam = after[title]["slam"]
    assert slam.map.n_keyframes >= 2
    assert slam.problems == []


def test_live_poses_end_where_the_camera_does(after, corridor):
    last, truth = after["Track a stereo camera and read poses live"], corridor.T_wc
    np.testing.assert_allclose(last["result"].T_wc[:3, 3], truth[-1, :3, 3], atol=0.1)
    assert len(after["file"]) == len(last["trajectory"]) == len(corridor.left)
    assert list(last["camera"].intrinsics) == list(corridor.camera.intrinsics)


def test_a_loop_is_told_once(after, capsys):
    """The corridor has no loop. Therefore, the test makes one up."""
    edge = LoopEdge(4, 0, 0.5, True, "closed", 90, 60)

    class Closing(Slam):
        loops = property(lambda self: [edge] if self.frame and self.frame.index >= 9 else [])

    (code,) = (code for title, code in RECIPES.items() if "loops as they close" in title)
    values = after["Track a stereo camera and read poses live"] | {"Slam": Closing}
    exec(compile(code, PAGE.name, "exec"), values)
    said = capsys.readouterr().out
    assert said.count("keyframes 0 and 4: closed, 60 inliers") == 1
    assert said.count("the trajectory has changed: (10, 4, 4)") == 1
