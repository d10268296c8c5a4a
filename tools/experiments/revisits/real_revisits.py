"""Count the loops that each detector closes on recorded drives with a known revisit.

    python tools/experiments/revisits/real_revisits.py --detectors bow,capsule \
        --revisit DATA,SENSOR,FRAMES,QUERY,MATCH ... --out real_revisits.csv

DATA is a folder that ``vslam run`` reads, with ``:SEQ`` for a sequence of a data set. SENSOR is
``stereo`` or ``mono``. FRAMES is the number of frames to read. QUERY and MATCH are ranges of
frames, such as ``330-345``: the frames QUERY show the place of the frames MATCH again. A closed
loop is right if both of its frames are at most ``--tolerance`` frames outside of these ranges.
Otherwise, it is wrong. The revisit is found if a right loop was closed.
"""

from __future__ import annotations

import argparse
import csv
from pathlib import Path
from typing import NamedTuple

from vslam.datasets.sources import open_source
from vslam.run.options import RunOptions
from vslam.slam import Slam


class Revisit(NamedTuple):
    data: str
    sensor: str
    frames: int
    query: range
    match: range


def revisit_of(text: str) -> Revisit:
    """Parse the value of ``--revisit``."""
    data, sensor, frames, query, match = text.split(",")
    return Revisit(data, sensor, int(frames), range_of(query), range_of(match))


def range_of(text: str) -> range:
    first, last = map(int, text.split("-"))
    return range(first, last + 1)


def is_right(frames: tuple[int, int], revisit: Revisit, tolerance: int) -> bool:
    """Return whether a loop between a query frame and a match frame belongs to the revisit."""
    return all(
        within.start - tolerance <= frame < within.stop + tolerance
        for frame, within in zip(frames, (revisit.query, revisit.match), strict=True)
    )


def closed_loops(revisit: Revisit, detector: str) -> list[tuple[int, int]]:
    """Return the frames (query, match) of the loops that a run closes."""
    data, _, seq = revisit.data.partition(":")
    options = RunOptions(
        data=data, seq=seq or None, sensor=revisit.sensor, max_frames=revisit.frames
    )
    source = open_source(options)
    slam = Slam(source.camera, detector=detector)
    for frame in source.frames():
        left, right = frame.read(map)
        slam.step(left, right, frame.timestamp)
    slam.finish()
    at = slam.map.frames.tolist()
    return [(at[loop.query], at[loop.match]) for loop in slam.loops if loop.accepted]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--revisit", nargs="+", required=True, type=revisit_of)
    parser.add_argument("--detectors", default="bow,capsule,both,capsule-paper")
    parser.add_argument("--tolerance", type=int, default=15)
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    rows = []
    for revisit in options.revisit:
        for detector in options.detectors.split(","):
            loops = closed_loops(revisit, detector)
            right = [one for one in loops if is_right(one, revisit, options.tolerance)]
            rows.append(
                {
                    "sequence": Path(revisit.data.replace(":", "_")).name,
                    "sensor": revisit.sensor,
                    "system": detector,
                    "loops_found": int(bool(right)),
                    "loops_missed": int(not right),
                    "loops_wrong": len(loops) - len(right),
                    "first_query": min((query for query, _ in right), default=""),
                }
            )
            print(*rows[-1].values(), flush=True)
    with options.out.open("w", newline="") as file:
        table = csv.DictWriter(file, list(rows[0]))
        table.writeheader()
        table.writerows(rows)


if __name__ == "__main__":
    main()
