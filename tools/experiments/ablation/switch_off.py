"""Switch off the parts of the method one at a time, and compare the errors on the same drives.

python tools/experiments/ablation/switch_off.py --source "--dataset synthetic --seqs demo" \\
    --perturb none,noise:1 --out FOLDER

Each ``--source`` contains the options of ``vslam bench`` that select drives. The runs are kept in
the output folder, so that the same command resumes an interrupted experiment. The table
``ablation.csv`` in this folder has a row for each part, data set and perturbation.
"""

from __future__ import annotations

import argparse
import csv
import shlex
import subprocess
from pathlib import Path
from statistics import median
from typing import NamedTuple

from vslam_lab.overview.schema import OverviewJson


class Variant(NamedTuple):
    """One part of the method, and how vslam is run without this part.

    ``thresholds`` are the values of ``--config`` that switch the part off. ``reference`` is the
    variant with which the runs are compared.
    """

    piece: str
    thresholds: str
    detector: str = "both"
    reference: str = "nothing"


VARIANTS = (
    Variant("nothing", ""),
    Variant("tracking by patches", "tracking.method=orb"),
    Variant(
        "alignment of matches",
        "tracking.method=orb,alignment.min_correlation=1",
        reference="tracking by patches",
    ),
    Variant("weight of aligned matches", "alignment.certainty=1"),
    Variant("triangulation", "mapping.epipolar_distance=0"),
    Variant("five of ten neighbours", "mapping.neighbours=5"),
    Variant("fusion of landmarks", "mapping.fuse_distance=0"),
    Variant("local bundle adjustment", "mapping.ba_iterations=1"),
    Variant("culling of keyframes", "mapping.redundant_ratio=1"),
    Variant("known places", "keyframes.known_ratio=1000"),
    Variant("offset of disparities", "stereo.offset_sigma=0"),
    Variant(
        "preparation of weak images",
        "weak_images.noise_from=1000,weak_images.spikes_from=1,weak_images.few_features=0",
    ),
    Variant("search for doubtful frames", "relocalization.doubtful_share=0"),
    Variant("loop closing", "", "none"),
    Variant("capsule network", "", "bow"),
    Variant("bag of words", "", "capsule"),
    Variant("learned verification", "verification.descriptors=orb"),
    Variant("agreement of keyframes", "consistency.min_keyframes=1,consistency.max_wrong=0.5"),
    Variant("global bundle adjustment", "loops.global_iterations=1"),
)

TOWN_CHANGES = ("change", "moving", "aliased")
Drive = tuple[str, str, str, int | None]  # data set, drive, perturbation, seed of the town
Measures = dict[str, float | None]


def run(variant: Variant, source: str, arguments: list[str], out: Path) -> dict[Drive, Measures]:
    """Run a variant on the drives of a source. Runs that are already finished are not repeated."""
    command = ["vslam", "bench", *shlex.split(source), *arguments]
    if variant.thresholds:
        command += ["--config", variant.thresholds]
    command += ["--detectors", variant.detector, "--seeds", "1", "--out", str(out), "--quiet"]
    if subprocess.run(command).returncode:
        raise SystemExit(f"{shlex.join(command)} failed")
    report = OverviewJson.model_validate_json((out / "report.json").read_bytes())
    return {
        (one.drive.dataset, str(one.drive), applied(one.drive.perturb), one.town): one.measures
        for one in report.runs
    }


def applied(perturb: str) -> str:
    """Return the ``--perturb`` of a drive, without changes of the town such as moving cars."""
    laws = [law for law in perturb.split(",") if law.partition(":")[0] not in TOWN_CHANGES]
    return "+".join(laws) or "none"


def row_of(
    variant: Variant,
    condition: tuple[str, str],
    runs: dict[Drive, Measures],
    reference: dict[Drive, Measures],
) -> dict[str, object]:
    """Make the row of the table for a part, a data set and a perturbation.

    The row contains the error without the part, divided by the error with the part. It also
    contains the numbers of loops.

    ``condition`` contains the data set and the ``--perturb`` of the drives in this row.
    """
    drives = [drive for drive in runs if condition == (drive[0], drive[2])]

    def ratios(name: str) -> list[float]:
        pairs = [(runs[drive][name], reference[drive][name]) for drive in drives]
        return [off / on for off, on in pairs if off is not None and on]

    def total(name: str) -> int:
        return round(sum(runs[drive][name] or 0 for drive in drives))

    ate, rpe = ratios("ate_rmse_m"), ratios("rpe_m")
    return {
        "without": variant.piece,
        "thresholds": variant.thresholds or f"--detector {variant.detector}",
        "compared_with": variant.reference,
        "dataset": condition[0],
        "perturb": condition[1],
        "drives": len(drives),
        "ate_ratio": f"{median(ate):.3f}",
        "ate_larger": sum(ratio > 1.02 for ratio in ate),
        "ate_smaller": sum(ratio < 1 / 1.02 for ratio in ate),
        "rpe_ratio": f"{median(rpe):.3f}",
        "lost_frames": total("lost_frames"),
        "loops_found": total("loops_found"),
        "loops_missed": total("loops_missed"),
        "loops_wrong": total("loops_wrong"),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--source", action="append", required=True)
    parser.add_argument("--perturb", default="none")
    parser.add_argument("--only", default="", help="only pieces whose name contains this")
    parser.add_argument("--jobs", default="2")
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    arguments = ["--perturb", options.perturb, "--jobs", options.jobs]
    runs: dict[str, dict[Drive, Measures]] = {}
    rows = []
    named = [one for one in VARIANTS if options.only in one.piece]
    references = {"nothing", *(one.reference for one in named)}
    chosen = [one for one in VARIANTS if one in named or one.piece in references]
    for variant in chosen:
        runs[variant.piece] = {}
        for k, source in enumerate(options.source):
            folder = options.out / variant.piece.replace(" ", "-") / str(k)
            runs[variant.piece] |= run(variant, source, arguments, folder)
        rows += [
            row_of(variant, condition, runs[variant.piece], runs[variant.reference])
            for condition in dict.fromkeys((one[0], one[2]) for one in runs[variant.piece])
        ]
    with (options.out / "ablation.csv").open("w", newline="") as file:
        table = csv.DictWriter(file, rows[0], lineterminator="\n")
        table.writeheader()
        table.writerows(rows)


if __name__ == "__main__":
    main()
