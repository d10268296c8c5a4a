"""Draw the first loop that a run closed.

The picture shows the two images of the loop with their matches, and the map from above.

python tools/experiments/loops/loop_picture.py RUN OUT.jpg
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from numpy.typing import NDArray

from vslam.maps.storage import load_map
from vslam.maps.stored_map import StoredMap
from vslam.types.geometry import inverses

INCHES, DOTS_PER_INCH = (6.44, 2.7), 200  # size of the map, which is as wide as the loop's picture
MARGIN = 20.0  # metres around the path
BAR = 20.0  # length of the scale bar in metres
DARK, LIGHT, GREEN = "#111721", "#e8ebf0", "#34d399"
TIME = LinearSegmentedColormap.from_list("time", ["#fbbf24", "#fb923c", "#6366f1", "#60a5fa"])


def draw(run: Path) -> NDArray[np.uint8]:
    """Draw the two images of a loop above the map of the run, as ``(H, W, 3)`` uint8 BGR."""
    stored = load_map(run / "map.npz")
    ends = [stored.loops[0].match, stored.loops[0].query]
    match, query = stored.map.frames[ends]
    seen = cv2.imread(str(run / "figures" / f"loop-{query}-{match}.jpg"))
    return np.vstack([seen, _draw_map(stored, ends, (f"frame {match}", f"frame {query}"))])


def _draw_map(stored: StoredMap, ends: list[int], names: tuple[str, str]) -> NDArray[np.uint8]:
    """Draw the landmarks and the camera path from above, coloured by time.

    The z axis of the map points to the right.
    """
    arrays = stored.map.arrays
    path = inverses(arrays.T_cw)[:, [2, 0], 3]
    figure = Figure(INCHES, DOTS_PER_INCH, facecolor=DARK)
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set_axis_off()
    time = arrays.first_keyframe
    axes.scatter(arrays.xyz[:, 2], arrays.xyz[:, 0], s=1.2, c=time, cmap=TIME, linewidths=0)
    axes.plot(*path.T, color=LIGHT, linewidth=1.0)
    axes.plot(*path[ends].T, "o-", color=GREEN, markersize=4.5, linewidth=1.4)
    box = {"facecolor": DARK, "alpha": 0.8, "linewidth": 0, "pad": 1.0}
    for name, at, side in zip(names, path[ends], (1.0, -1.0), strict=True):
        axes.text(
            at[0], at[1] + 5.0 * side, name, size=7, color=GREEN, bbox=box, ha="center", va="center"
        )
    low, high = path.min(0) - MARGIN, path.max(0) + MARGIN
    middle, half = (low[0] + high[0]) / 2.0, (high[1] - low[1]) / 2.0 * INCHES[0] / INCHES[1]
    axes.set(xlim=(middle - half, middle + half), ylim=(high[1], low[1]))
    axes.plot([low[0], low[0] + BAR], [high[1] - 4.0] * 2, color=LIGHT, linewidth=1.2)
    axes.text(low[0], high[1] - 6.0, f"{BAR:.0f} m", size=7, color=LIGHT, bbox=box)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return cv2.cvtColor(np.asarray(canvas.buffer_rgba()), cv2.COLOR_RGBA2BGR)


if __name__ == "__main__":
    cv2.imwrite(sys.argv[2], draw(Path(sys.argv[1])), [cv2.IMWRITE_JPEG_QUALITY, 85])
