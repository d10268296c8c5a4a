"""Fit the weights with which the evidence of a loop is weighed (``loopclosure/evidence.py``).

``collect`` drives through rendered towns without closing loops, verifies pairs of keyframes with
ORB and with learned descriptors, and writes what was found and whether the pose is right. The
pairs are all that share no landmark (at most 6,000 of a drive, for ORB), and the three most similar
ones of each keyframe (for both). ``fit`` prints the weights and, for each drive, how many pairs are
verified rightly and wrongly with weights that were fitted to the other drives.

    python tools/experiments/loops/evidence.py collect pairs.csv demo+aliased+seed:1 05 night
    python tools/experiments/loops/evidence.py fit pairs.csv
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy.optimize import minimize
from scipy.special import expit

from vslam.config import Config
from vslam.datasets import open_sequence
from vslam.datasets.perturbation import parse_perturbation, perturbed
from vslam.loopclosure import verification
from vslam.loopclosure.evidence import Weights
from vslam.loopclosure.learned_verification import verify_learned
from vslam.loopclosure.local_matching import MIN_COARSE_SIMILARITY, likeness
from vslam.loopclosure.registry import create_images
from vslam.run.outcome import ground_truth_of
from vslam.slam import Slam
from vslam.types.geometry import inverse, se3_log
from vslam.types.loops import LoopCandidate, LoopEdge, LoopEvidence
from vslam.types.map import Map

COLUMNS = ["drive", "perturb", "query", "match", "matched_by", *LoopEvidence._fields]
ERRORS = ["metres", "degrees"]
RIGHT_METRES, RIGHT_DEGREES = 1.0, 3.0
APART = 15  # keyframes between the two of a pair, at least
MOST_PAIRS, MOST_SIMILAR = 6000, 3


def collect(out: Path, drive: str, perturb: str, seed: int) -> None:
    name, _, limit = drive.partition("@")
    source = open_sequence("synthetic", "", name, max_frames=int(limit) if limit else None)
    truth = ground_truth_of(source)
    assert truth is not None
    config, images = Config(), create_images("both", Config())
    assert images is not None
    slam = Slam(source.camera, config, "none", threads=1)
    frames, lefts = source.frames(), []
    if perturb != "none":
        frames = perturbed(frames, parse_perturbation(perturb, seed).bound_to(source))
    for frame in frames:
        left, right = frame.read(map)
        slam.step(left, right, frame.timestamp)
        lefts.append(left)
    slam.finish()
    map_ = slam.map
    for keyframe in map_.living_keyframes().tolist():
        images.add(keyframe, lefts[map_.frames[keyframe]])

    def edges() -> Iterator[LoopEdge]:
        for candidate in pairs_of(map_, images, config):
            yield verification.verify(map_, candidate, slam.context)
            if candidate.similarity is not None:
                yield verify_learned(map_, candidate, images, slam.context)

    def true_pose(keyframe: int) -> np.ndarray:
        nearest = np.argmin(np.abs(truth.timestamps - map_.timestamps[keyframe]))
        return truth.T_wc[int(nearest)]

    new = not out.exists()
    with out.open("a", newline="") as file:
        writer = csv.writer(file)
        if new:
            writer.writerow([*COLUMNS, *ERRORS])
        for edge in edges():
            if edge.evidence is None:
                continue
            T_query_match = inverse(true_pose(edge.query)) @ true_pose(edge.match)
            error = se3_log(inverse(T_query_match) @ edge.T_query_match)
            metres = np.linalg.norm(error[:3])
            degrees = np.degrees(np.linalg.norm(error[3:]))
            entry = drive, perturb, edge.query, edge.match, edge.matched_by, *edge.evidence
            writer.writerow([*entry, metres, degrees])


def pairs_of(map_: Map, images, config: Config) -> list[LoopCandidate]:
    """Choose the pairs of keyframes. Those with a similarity are also verified with learned
    descriptors."""
    living = map_.living_keyframes().tolist()
    near = {k: set(map_.covisible(k)[0].tolist()) for k in living}
    chosen: list[LoopCandidate] = []
    for query in [k for k in living if k in images]:
        glance = images.glance(query)
        others = [m for m in living if m in images and m < query - APART and m not in near[query]]
        least = MIN_COARSE_SIMILARITY
        similar = sorted((likeness(glance, images.glance(m), least), m) for m in others)
        for similarity, match in similar[-MOST_SIMILAR:]:
            if similarity >= config.learned.min_similarity:
                chosen.append(LoopCandidate(query, match, 0.0, similarity=similarity))
    every = [(q, m) for q in living for m in living if m < q - APART and m not in near[q]]
    rng = np.random.default_rng(0)
    some = rng.permutation(len(every))[:MOST_PAIRS]
    return chosen + [LoopCandidate(*every[i], 0.0) for i in some.tolist()]


# The odds of a wrong loop do not rise when more is seen, nor when the pose is determined better.
BOUNDS = [(None, None), (None, 0), (None, 0), (None, 0), (0, None), (0, None)]


def fitted(log_evidence: np.ndarray, wrong: np.ndarray, ridge: float = 1.0) -> Weights:
    """Fit logistic regression. Right and wrong pairs have the same total weight."""
    mean, scale = log_evidence.mean(0), log_evidence.std(0)
    X = np.column_stack([np.ones(len(wrong)), (log_evidence - mean) / scale])
    sign = np.where(wrong, 1.0, -1.0)
    weight = np.where(wrong, 1.0 / wrong.sum(), 1.0 / (~wrong).sum()) * len(wrong) / 2

    def cost(b: np.ndarray) -> tuple[float, np.ndarray]:
        margin = sign * (X @ b)
        slope = -weight * sign * expit(-margin)
        ridged = np.r_[0.0, b[1:]] * ridge
        return weight @ np.logaddexp(0.0, -margin) + ridged @ b / 2, slope @ X + ridged

    b = minimize(cost, np.zeros(X.shape[1]), jac=True, bounds=BOUNDS).x
    slope = b[1:] / scale
    return Weights(float(b[0] - slope @ mean), *slope.tolist())


def fit(path: Path) -> None:
    with path.open() as file:
        entries = list(csv.DictReader(file))
    for matched_by in ("orb", "learned"):
        chosen = [entry for entry in entries if entry["matched_by"] == matched_by]
        x = np.log([[float(entry[name]) for name in LoopEvidence._fields] for entry in chosen])
        far = [float(entry["metres"]) > RIGHT_METRES for entry in chosen]
        turned = [float(entry["degrees"]) > RIGHT_DEGREES for entry in chosen]
        wrong = np.array(far) | np.array(turned)
        drive = np.array([f"{entry['drive']} {entry['perturb']}" for entry in chosen])
        print(f"{matched_by}: {np.count_nonzero(~wrong)} right, {np.count_nonzero(wrong)} wrong")
        print("  ", fitted(x, wrong))
        for one in np.unique(drive):
            test = drive == one
            constant, *slope = fitted(x[~test], wrong[~test])
            odds = constant + x[test] @ slope
            p_wrong, bad = 1.0 / (1.0 + np.exp(-odds)), wrong[test]
            counts = [
                f"{np.count_nonzero(p_wrong[~bad] < limit)}/{np.count_nonzero(~bad)} right, "
                f"{np.count_nonzero(p_wrong[bad] < limit)}/{np.count_nonzero(bad)} wrong"
                for limit in (0.5, 1e-3)
            ]
            least = p_wrong[bad].min(initial=1.0)
            print(
                f"   {one:40} below 0.5: {counts[0]}; below 0.001: {counts[1]}; "
                f"smallest of a wrong one {least:.2g}"
            )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=["collect", "fit"])
    parser.add_argument("path", type=Path)
    parser.add_argument("drives", nargs="*")
    parser.add_argument("--perturb", default="none")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    if given.what == "fit":
        fit(given.path)
    for drive in given.drives:
        collect(given.path, drive, given.perturb, given.seed)


if __name__ == "__main__":
    main()
