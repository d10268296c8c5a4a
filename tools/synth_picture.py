"""Draw docs/images/demo.jpg: a rendered frame with its keypoints beside the run from above.

python tools/synth_picture.py runs/latest docs/images/demo.jpg [FRAME]
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np

from vslam.config import OrbConfig
from vslam.datasets.synthetic import open_synthetic
from vslam.evaluation.trajectories import evaluate_trajectory, read_pair
from vslam.frontend.orb import extract

HEIGHT = 376
INK, TRUTH, PATH = (40, 40, 40), (150, 150, 150), (60, 90, 230)


def main(folder: Path, out: Path, frame: int) -> None:
    left, _ = open_synthetic("demo").read(frame)
    picture = cv2.cvtColor(left, cv2.COLOR_GRAY2BGR)
    for x, y in extract(left, OrbConfig()).xy.tolist():
        cv2.circle(picture, (round(x), round(y)), 3, (80, 220, 90), 1, cv2.LINE_AA)
    estimate, truth = read_pair(
        folder / "trajectory_kitti.txt", folder / "ground_truth_kitti.txt", None
    )
    top = np.full((HEIGHT, HEIGHT, 3), 255, np.uint8)
    places = truth.T_wc[:, [0, 2], 3]
    scale = (HEIGHT - 50) / np.ptp(places, axis=0).max()
    middle = 0.5 * (places.max(axis=0) + places.min(axis=0))
    for track, colour, width in ((truth, TRUTH, 5), (estimate, PATH, 2)):
        at = (track.T_wc[:, [0, 2], 3] - middle) * [scale, -scale] + HEIGHT / 2
        cv2.polylines(top, [np.rint(at).astype(np.int32)], False, colour, width, cv2.LINE_AA)
    error = evaluate_trajectory(estimate, truth, "se3").ate_rmse_m
    label = f"ATE {error:.2f} m of {len(truth)} frames"
    cv2.putText(top, label, (10, HEIGHT - 10), cv2.FONT_HERSHEY_SIMPLEX, 0.5, INK, 1, cv2.LINE_AA)
    sheet = np.hstack([picture, top])
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_bytes(cv2.imencode(".jpg", sheet, [cv2.IMWRITE_JPEG_QUALITY, 85])[1].tobytes())


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]) if len(sys.argv) > 3 else 60)
