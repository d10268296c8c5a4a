"""Drives in KITTI's format with frames left out or changed, and the systems run over them: shared
by synth_table.py and motorway_variants.py."""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Collection, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import compare_orbslam3
from compare_orbslam3 import Run


@contextmanager
def changed_drive(
    source: Path, name: str, frames: Sequence[int], law: str, black: Collection[int] = ()
) -> Iterator[Path]:
    """A KITTI tree, in a temporary folder, with some ``frames`` of the sequence ``name`` of the
    tree ``source``, perturbed by a ``law`` of ``vslam run --perturb`` with seed 0, or ``black``."""
    import cv2
    import numpy as np

    from vslam.datasets import open_sequence
    from vslam.datasets.perturbation import parse_perturbation

    sequence = open_sequence("kitti", source, name)
    perturbation = parse_perturbation(law, 0).bound_to(sequence)
    with tempfile.TemporaryDirectory(prefix="vslam-drive-") as scratch:
        root = Path(scratch)
        folder = root / "sequences" / name
        sides = [folder / "image_0", folder / "image_1"]
        for made in (*sides, root / "poses"):
            made.mkdir(parents=True)
        calibration = source / "sequences" / name / "calib.txt"
        (folder / "calib.txt").write_bytes(calibration.read_bytes())
        for file in (Path("sequences", name, "times.txt"), Path("poses", f"{name}.txt")):
            lines = (source / file).read_text().splitlines()
            (root / file).write_text("".join(f"{lines[k]}\n" for k in frames))

        def write(number: int) -> None:
            k = frames[number]
            t = float(sequence.timestamps[k] - sequence.timestamps[0])
            images = perturbation.apply(k, t, *sequence.read(k))
            for side, image in zip(sides, images, strict=True):
                image = np.zeros_like(image) if k in black else image
                path = side / f"{number:06d}.png"
                cv2.imwrite(str(path), image, [cv2.IMWRITE_PNG_COMPRESSION, 1])

        with ThreadPoolExecutor(2) as pool:
            list(pool.map(write, range(len(frames))))
        yield root


def run_over(
    data: Path, name: str, options: argparse.Namespace, detector: str | None, **more: Any
) -> tuple[Run, dict[str, float]]:
    """Run vslam with a detector, or ORB-SLAM3 for None, over all frames of a drive.

    Args:
        options: where ORB-SLAM3 is.
        more: options of ``compare_orbslam3.run_vslam``.
    """
    found = {
        name: path and path.absolute()
        for name, path in vars(options).items()
        if name in ("orbslam3_python", "orbslam3_script", "vocabulary")
    }
    frames = len(list((data / "sequences" / name / "image_0").iterdir()))
    run_options = argparse.Namespace(
        data=data,
        seq=name,
        frames=frames,
        threads=None,
        detector=detector,
        vslam=str(Path(sys.executable).with_name("vslam")),
        **found,
        **more,
    )
    run = compare_orbslam3.run_orbslam3 if detector is None else compare_orbslam3.run_vslam
    with tempfile.TemporaryDirectory(prefix="vslam-table-") as scratch:
        done = run(run_options, Path(scratch))
        return done, compare_orbslam3.figures(done, run_options)
