r"""Print noise, spikes and contrast of a sequence's left images, measured as in
``frontend/weak_images.py``, and the number of features that ``extract`` finds.

python tools/experiments/stress/image_noise.py --data "$KITTI_ROOT" --seq 00 \
    --max-frames 216 --perturb night:3.75
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from vslam.config import OrbConfig
from vslam.datasets import open_sequence
from vslam.datasets.perturbation import parse_perturbation
from vslam.frontend.orb import extract
from vslam.frontend.weak_images import LEAST_SPIKE, ROW_STRIDE, contrast, grain


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--dataset", default="kitti")
    parser.add_argument("--data", type=Path)
    parser.add_argument("--seq", default="00")
    parser.add_argument("--max-frames", type=int)
    parser.add_argument("--perturb", default="none")
    parser.add_argument("--images", type=int, default=12, help="number of images, evenly spread")
    args = parser.parse_args()
    sequence = open_sequence(args.dataset, args.data, args.seq, max_frames=args.max_frames)
    perturbation = parse_perturbation(args.perturb, 0).bound_to(sequence)
    found = []
    for k in np.unique(np.linspace(0, len(sequence) - 1, args.images).astype(int)).tolist():
        t = float(sequence.timestamps[k] - sequence.timestamps[0])
        left, _ = perturbation.apply(k, t, *sequence.read(k))
        noise, spikes = grain(left, ROW_STRIDE, LEAST_SPIKE)
        found.append((noise, 100.0 * spikes, contrast(left), len(extract(left, OrbConfig()).xy)))
    names = ("noise, grey levels", "spikes, %", "contrast, grey levels", "features")
    for name, values in zip(names, np.array(found).T, strict=True):
        print(f"{name:22s} {values.min():8.2f} {np.median(values):8.2f} {values.max():8.2f}")


if __name__ == "__main__":
    main()
