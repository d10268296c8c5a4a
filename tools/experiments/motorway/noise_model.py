"""Estimate the noise of the columns, rows and disparities of features from finished stereo maps.

    python tools/experiments/motorway/noise_model.py runs/one runs/two

The map of each run is adjusted, and the standard deviations of u, v and the disparity, in pixels of
the feature's octave, are estimated as variance components (W. Foerstner, "Ein Verfahren zur
Schaetzung von Varianz- und Kovarianzkomponenten", 1979). The squared residuals of each kind are
divided by its redundancy: the number of observations minus the part that landmarks can fit. A kind
thus does not seem precise merely because it has a large weight. The adjustment is repeated with the
new weights until they converge. The degrees of freedom of the poses are neglected, six for hundreds
of observations. u and v are those of aligned matches and first observations; other matches are
assumed to have four times their variance.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vslam.backend.bundle_adjustment import BundleProblem
from vslam.backend.global_bundle_adjustment import adjust_globally
from vslam.backend.global_mapping import take_snapshot
from vslam.camera import DISPARITY_WEIGHT
from vslam.maps.storage import load_map

ROUNDS = 8
START = (0.5, 0.5, 0.2)  # pixels, of u, v, disparity
GATE = 4.0  # standard deviations; an observation beyond it in any component is an outlier


def variance_components(
    problem: BundleProblem, sigma: NDArray[np.float64]
) -> tuple[BundleProblem, NDArray[np.float64], int]:
    """Adjust the problem under the ``(3,)`` sigma of u, v, disparity. Returns the adjusted problem,
    the ``(3,)`` sigma of its residuals, and the number of stereo observations without outliers.

    As in vslam, u and v have the same weight, also in monocular observations.
    """
    pixel = float(np.sqrt(np.mean(sigma[:2] ** 2)))
    certainty = (DISPARITY_WEIGHT / problem.disparity_weights()) ** 2
    octave = (problem.inverse_sigma2 / certainty) ** -0.5
    pixels = pixel * np.sqrt(certainty.max() / certainty)
    scaled = replace(
        problem,
        inverse_sigma2=(octave * pixels) ** -2.0,
        disparity_weight=pixels / sigma[2],
    )
    solution = adjust_globally(scaled, iterations=10)
    owner = np.repeat(np.arange(len(problem.points)), np.diff(problem.first))
    adjusted = replace(problem, T_cw=solution.T_cw, points=solution.points)
    q = in_cameras(adjusted)
    fx, fy, cx, cy, bf, _ = problem.intrinsics
    x, y, z = q.T
    u, v, disparity = fx * x / z + cx, fy * y / z + cy, bf / z
    error = np.stack(
        [
            problem.uvr[:, 0] - u,
            problem.uvr[:, 1] - v,
            problem.uvr[:, 0] - problem.uvr[:, 2] - disparity,
        ],
        axis=1,
    )
    error /= octave[:, None]
    stereo = np.isfinite(error[:, 2])
    with np.errstate(invalid="ignore"):
        gate = GATE * np.stack([pixels, pixels, np.full_like(pixels, sigma[2])], axis=1)
        good = (z > 0) & (np.abs(np.nan_to_num(error)) < gate).all(axis=1)
    # Rows of d(u, v, disparity)/d(point) in units of sigma.
    R = solution.T_cw[problem.camera, :3, :3]
    nil = np.zeros_like(z)
    P = np.stack(
        [
            np.stack([fx / z, nil, -fx * x / z**2], axis=1),
            np.stack([nil, fy / z, -fy * y / z**2], axis=1),
            np.stack([nil, nil, -bf / z**2], axis=1),
        ],
        axis=1,
    )
    spread = octave[:, None] * gate / GATE
    J = np.einsum("oij,ojk->oik", P, R) / spread[:, :, None]
    J[~stereo, 2] = 0.0
    J[~good] = 0.0
    V = np.zeros((len(problem.points), 3, 3))
    np.add.at(V, owner, np.einsum("oki,okj->oij", J, J))
    lever = np.einsum("oki,oij,okj->ok", J, np.linalg.pinv(V, hermitian=True)[owner], J)
    counted = good & stereo & (certainty == certainty.max())
    redundancy = (1.0 - lever[counted]).sum(axis=0)
    found = np.sqrt((error[counted] ** 2).sum(axis=0) / redundancy)
    return adjusted, found, int(counted.sum())


def in_cameras(problem: BundleProblem) -> NDArray[np.float64]:
    """``(O, 3)`` point of each observation in its camera's frame."""
    point = np.repeat(np.arange(len(problem.points)), np.diff(problem.first))
    T = problem.T_cw[problem.camera]
    return np.einsum("nij,nj->ni", T[:, :3, :3], problem.points[point]) + T[:, :3, 3]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("runs", nargs="+", type=Path, help="folders of stereo runs")
    print("| run | observations | u | v | disparity | times surer |")
    print("|---|---|---|---|---|---|")
    for folder in parser.parse_args().runs:
        stored = load_map(folder / "map.npz")
        problem = take_snapshot(stored.map, stored.camera).problem
        sigma = np.array(START)
        for _ in range(ROUNDS):
            problem, sigma, count = variance_components(problem, sigma)
        u, v, disparity = sigma
        print(
            f"| {folder.parent.name} | {count} | {u:.2f} | {v:.2f} | {disparity:.2f} "
            f"| {np.hypot(u, v) / np.sqrt(2.0) / disparity:.1f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
