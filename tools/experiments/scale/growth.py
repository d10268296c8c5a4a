"""Simulate how cost and memory grow with the number of keyframes in a map.

    python tools/experiments/scale/growth.py --write docs/research/scale.md \
        --figure docs/research/scale.svg

Each street of a town with crossings is driven once. A keyframe every 5 m has 2,000 features, of
which 560 observe landmarks, 140 of them new (565 and 132 in the rendered town along KITTI 05). At a
crossing, both streets observe some common landmarks. Words are drawn with their frequency in the
training images. Each size runs in a separate process.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vslam.backend.bundle_adjustment import BundleProblem
from vslam.backend.global_bundle_adjustment import adjust_globally
from vslam.backend.pose_graph import check_pose_graph, essential_graph, optimise
from vslam.camera import Camera
from vslam.config import Config
from vslam.features import Features
from vslam.geometry import compose, inverse, inverses, se3_exp
from vslam.loopclosure.bow import BowDetector
from vslam.loopclosure.vocabulary import load
from vslam.loops import LoopEdge, PerKeyframe
from vslam.map import Map
from vslam.map_kernels import link_many
from vslam.map_view import local_map

CONFIG = Config()
CAMERA = Camera(718.856, 718.856, 607.2, 185.2, 0.54, 1241, 376)
STEP_M, BLOCK = 5.0, 20  # between keyframes, and keyframes between crossings
FEATURES, NEW, AHEAD = 2000, 140, 3  # features, new landmarks, further keyframes that see these
SHARED = 40  # landmarks of a keyframe at a crossing that the other street sees
REPEATS = 30
BEGIN, END = "<!-- growth -->\n", "<!-- /growth -->\n"
FIGURES = Path("docs/research/scale.json")
SIZES = (1250, 2500, 5000, 10000, 20000, 50000)


@dataclass(frozen=True)
class Town:
    """K keyframes ``T_cw`` (K, 4, 4); ``crossing`` (C, 2) keyframes of two streets at one place;
    ``observed`` (O, 2) keyframe and landmark, in the order of landmarks; ``points`` (L, 3)."""

    T_cw: NDArray[np.float64]
    crossing: NDArray[np.int64]
    observed: NDArray[np.int64]
    points: NDArray[np.float64]


def town(n: int) -> Town:
    """A square grid with just enough streets for ``n`` keyframes."""
    streets = max(2, int(np.ceil(np.sqrt(n / (2 * BLOCK)))))
    length = -(-n // (2 * streets))
    street, along = np.divmod(np.arange(n), length)
    across = street >= streets
    offset = (street % streets) * BLOCK * STEP_M
    x, z = along * STEP_M, offset
    xz = np.where(across[:, None], np.stack([x, z], axis=1), np.stack([z, x], axis=1))
    T_wc = np.array([se3_exp(np.array([0.0, 0, 0, 0, turn, 0])) for turn in (0.0, np.pi / 2)])
    T_wc = T_wc[across.astype(int)].copy()
    T_wc[:, [0, 2], 3] = xz
    rng = np.random.default_rng(0)
    ahead = rng.uniform(AHEAD * STEP_M + 5.0, 45.0, (n, NEW))
    side = rng.uniform(-0.5, 0.5, (n, NEW)) * (ahead - AHEAD * STEP_M)
    up = rng.uniform(-0.15, 0.15, (n, NEW)) * (ahead - AHEAD * STEP_M)
    local = np.stack([side, up, ahead], axis=2)
    points = np.einsum("nij,nkj->nki", T_wc[:, :3, :3], local) + T_wc[:, None, :3, 3]
    landmark = np.arange(n * NEW).reshape(n, NEW)
    seen = []
    for later in range(AHEAD + 1):
        k = np.arange(n - later)
        k = k[street[k] == street[k + later]]
        seen.append(np.stack([np.repeat(k + later, NEW), landmark[k].ravel()], axis=1))
    where = {(round(x), round(z)): k for k, (x, z) in enumerate(xz.tolist()) if not across[k]}
    crossing = [
        (where[place], k)
        for k, (x, z) in enumerate(xz.tolist())
        if across[k] and (place := (round(x), round(z))) in where
    ]
    pairs = np.array(crossing, np.int64).reshape(-1, 2)
    # One camera looks ahead, one to the right; common landmarks are between the two directions.
    common = landmark[pairs[:, 0], :SHARED]
    between = rng.uniform([8, -2, 8], [20, 1, 20], (len(pairs), SHARED, 3))
    points[pairs[:, 0], :SHARED] = T_wc[pairs[:, 0], None, :3, 3] + between
    lonely = np.zeros(n * NEW, np.bool_)
    lonely[common] = True
    seen = [seen[0], *(s[~lonely[s[:, 1]]] for s in seen[1:])]
    seen.append(np.stack([np.repeat(pairs[:, 1], SHARED), common.ravel()], axis=1))
    observed = np.concatenate(seen)
    observed = observed[np.lexsort((observed[:, 0], observed[:, 1]))]
    return Town(inverses(T_wc), pairs, observed, points.reshape(-1, 3))


def bundle(size: int) -> dict[str, float]:
    """Global bundle adjustment: seconds of preparation, seconds per iteration, memory."""
    t, rng = town(size), np.random.default_rng(1)
    camera, landmark = t.observed.T
    T = t.T_cw[camera]
    p = np.einsum("nij,nj->ni", T[:, :3, :3], t.points[landmark]) + T[:, :3, 3]
    u = CAMERA.fx * p[:, 0] / p[:, 2] + CAMERA.cx
    v = CAMERA.fy * p[:, 1] / p[:, 2] + CAMERA.cy
    uvr = np.stack([u, v, u - CAMERA.bf / p[:, 2]], axis=1) + rng.normal(0, 0.5, (len(p), 3))
    del T, p, u, v
    first = np.searchsorted(landmark, np.arange(len(t.points) + 1))
    moved = se3_exp_many(rng.normal(0, [0.05, 0.05, 0.05, 2e-3, 2e-3, 2e-3], (size, 6)))
    # The first keyframe is fixed, and fixed cameras come last.
    order = np.roll(np.arange(size), -1)
    number = np.argsort(order)
    T_cw = np.matmul(moved, t.T_cw)[order]
    T_cw[-1] = t.T_cw[0]
    problem = BundleProblem(
        T_cw=T_cw,
        n_free=size - 1,
        points=t.points + rng.normal(0, 0.05, t.points.shape),
        first=first,
        camera=number[camera],
        uvr=uvr,
        inverse_sigma2=np.ones(len(uvr)),
        intrinsics=CAMERA.intrinsics,
    )
    adjust_globally(small_part(problem), iterations=1)  # loads the kernels
    before = memory("VmRSS")
    reset_peak()
    start = time.process_time()
    adjust_globally(problem, iterations=0)
    prepared = time.process_time() - start
    start = time.process_time()
    done = adjust_globally(problem, iterations=4, tolerance=0.0).iterations
    return {
        "observations": len(uvr),
        "prepare_s": prepared,
        "iteration_s": (time.process_time() - start - prepared) / done,
        "mb": memory("VmHWM") - before,
    }


def small_part(problem: BundleProblem) -> BundleProblem:
    """A part of the problem with a few points."""
    last = int(problem.first[50])
    return BundleProblem(
        problem.T_cw, problem.n_free, problem.points[:50], problem.first[:51],
        problem.camera[:last], problem.uvr[:last], problem.inverse_sigma2[:last],
        problem.intrinsics,
    )  # fmt: skip


def se3_exp_many(twists: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.array([se3_exp(twist) for twist in twists])


def mapped(t: Town) -> Map:
    """The map of a town."""
    map_, n = Map(1.2 ** np.arange(8)), len(t.T_cw)
    nothing = np.full(FEATURES, np.nan, np.float32)
    features = Features(
        np.zeros((FEATURES, 2), np.float32), np.zeros(FEATURES, np.uint8),
        np.zeros(FEATURES, np.float32), np.zeros((FEATURES, 32), np.uint8), nothing,
    )  # fmt: skip
    by_keyframe = t.observed[np.argsort(t.observed[:, 0], kind="stable")]
    first = np.searchsorted(by_keyframe[:, 0], np.arange(n + 1))
    street = np.linalg.norm(np.diff(inverses(t.T_cw)[:, :3, 3], axis=0), axis=1) > 1.5 * STEP_M
    for k in range(n):
        map_.add_keyframe(features, t.T_cw[k], 0.5 * k, 5 * k)
        map_.parents[k] = k - 1
        map_.add_landmarks(t.points[k * NEW : (k + 1) * NEW], np.zeros((NEW, 4), np.uint64), k)
        ids = by_keyframe[first[k] : first[k + 1], 1].astype(np.int32)
        link_many(map_.arrays, map_.rows(k).start + np.arange(len(ids)), ids)
    for child, parent in {int(b): int(a) for a, b in t.crossing[::-1]}.items():
        if child and street[child - 1]:
            map_.parents[child] = parent
    return map_


def keyframe(size: int) -> dict[str, float]:
    """Costs of a new keyframe that depend on the map, and the memory of map and words."""
    t = town(size)
    vocabulary = load()
    before = memory("VmRSS")
    map_ = mapped(t)
    of_map = memory("VmRSS") - before
    popular = np.cumsum(np.exp(-vocabulary.weight.astype(float)))
    rng = np.random.default_rng(2)
    words = np.empty(size * FEATURES, np.int32)
    for part in np.array_split(words, -(-size // 500)):
        part[:] = np.searchsorted(popular, rng.random(len(part)) * popular[-1])
    detector, before = BowDetector(vocabulary), memory("VmRSS")
    known = PerKeyframe(FEATURES * np.arange(size + 1), words)
    detector.restore(replace(detector.memory(), tables={"words": known}))
    of_words = memory("VmRSS") - before
    newest = range(size - REPEATS, size)
    return {
        "map_mb": of_map,
        "words_mb": of_words,
        "query_ms": median_ms(lambda k: detector.query(k, map_), newest),
        "covisible_ms": median_ms(map_.covisible, newest),
        "local_map_ms": median_ms(lambda k: local_map(map_, k, 30), newest),
    }


def loop(size: int) -> dict[str, float]:
    """The pose graph of a loop between the newest keyframe and another street."""
    t = town(size)
    map_ = mapped(t)
    match, query = t.crossing[-1].tolist()
    drift = se3_exp(np.array([0.3, 0.0, 0.2, 0.0, 2e-3, 0.0]))
    T = compose(drift, compose(t.T_cw[query], inverse(t.T_cw[match])))
    edge = LoopEdge(query, match, 1.0, True, "closed", T_query_match=T)
    seconds = []
    for _ in range(2):  # the first loads GTSAM and kernels
        start = time.process_time()
        graph = essential_graph(map_, [edge], CONFIG.pose_graph)
        built = time.process_time()
        T_cw = optimise(graph, CONFIG.pose_graph)
        check_pose_graph(graph, T_cw, CONFIG.pose_graph)
        seconds = [built - start, time.process_time() - built]
    return {"graph_s": seconds[0], "optimise_s": seconds[1]}


def median_ms(call: Callable[[int], object], keyframes: range) -> float:
    times = []
    for k in keyframes:
        start = time.thread_time()
        call(k)
        times.append(1e3 * (time.thread_time() - start))
    return float(np.median(times))


def memory(key: str) -> float:
    """MB of this process: ``VmRSS`` is the current memory, ``VmHWM`` the peak."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(f"{key}:"):
            return int(line.split()[1]) / 2**10
    raise KeyError(key)


def reset_peak() -> None:
    Path("/proc/self/clear_refs").write_text("5")


@dataclass(frozen=True)
class Law:
    """``value = at_10000 * (keyframes / 10000) ** exponent``, fitted to the larger sizes."""

    exponent: float
    at_10000: float

    def at(self, n: float) -> float:
        return self.at_10000 * (n / 1e4) ** self.exponent


ROWS = (  # simulation, figure, title, unit
    ("keyframe", "query_ms", "loop query, a keyframe", "ms"),
    ("keyframe", "covisible_ms", "covisible keyframes", "ms"),
    ("keyframe", "local_map_ms", "local map for tracking", "ms"),
    ("loop", "graph_s", "pose graph of a loop, built", "s"),
    ("loop", "optimise_s", "the same, optimised", "s"),
    ("bundle", "prepare_s", "global bundle adjustment, prepared", "s"),
    ("bundle", "iteration_s", "the same, an iteration", "s"),
    ("bundle", "mb", "the same, memory", "MB"),
    ("keyframe", "map_mb", "map, memory", "MB"),
    ("keyframe", "words_mb", "words of all keyframes, memory", "MB"),
)
SIMULATIONS = {"bundle": bundle, "keyframe": keyframe, "loop": loop}
Figures = dict[int, dict[str, float]]  # by size; figures by the name of their row


def measure(sizes: list[int], limit_mb: float, kept: Path) -> Figures:
    """Run all simulations that fit into memory and are not yet in the file of figures."""
    found: Figures = {}
    if kept.exists():
        found = {int(size): figures for size, figures in json.loads(kept.read_text()).items()}
    for size in sizes:
        found.setdefault(size, {})
        for name in SIMULATIONS:
            if all(key in found[size] for of, key, *_ in ROWS if of == name):
                continue
            need = needed_mb(found, name, size)
            if need > limit_mb:
                print(f"{name} {size}: left out, because it would need {need / 1e3:.0f} GB")
                continue
            words = [sys.executable, __file__, "--simulate", name, "--sizes", str(size)]
            done = subprocess.run(words, check=True, capture_output=True, text=True)
            found[size] |= json.loads(done.stdout)
            kept.write_text(json.dumps(found, indent=1) + "\n")
            print(name, size, done.stdout.strip(), flush=True)
    return found


def needed_mb(found: Figures, name: str, size: int) -> float:
    """Estimated memory, extrapolated from the largest smaller size, plus a constant."""
    key = {"bundle": "mb", "keyframe": "map_mb", "loop": "map_mb"}[name]
    known = [(n, figures[key]) for n, figures in found.items() if key in figures and n < size]
    return 1.3 * known[-1][1] * size / known[-1][0] if known else 0.0


def law(found: Figures, key: str) -> Law:
    known = [(n, figures[key]) for n, figures in found.items() if key in figures]
    n, value = np.array(known[-4:]).T
    exponent, at = np.polyfit(np.log(n / 1e4), np.log(np.maximum(value, 1e-6)), 1)
    return Law(float(exponent), float(np.exp(at)))


def table(found: Figures, keys: Collection[str] = ()) -> str:
    """Rows of the named figures (default: all); extrapolated values are in parentheses."""
    sizes = list(found)
    lines = [
        "| | " + " | ".join(f"{n:,}" for n in sizes) + " | grows as |",
        "|---|" + "---|" * (len(sizes) + 1),
    ]
    for _, key, title, unit in ROWS:
        if keys and key not in keys:
            continue
        fitted = law(found, key)
        cells = [
            number(figures[key]) if (figures := found[n]).get(key) is not None
            else f"({number(fitted.at(n))})"
            for n in sizes
        ]  # fmt: skip
        lines.append(f"| {title}, {unit} | {' | '.join(cells)} | n^{fitted.exponent:.2f} |")
    return "\n".join(lines) + "\n"


def number(value: float) -> str:
    return f"{value:,.0f}" if value >= 100 else f"{value:.1f}" if value >= 10 else f"{value:.2f}"


def draw(found: Figures, path: Path) -> None:
    from matplotlib import style
    from matplotlib.figure import Figure

    from vslam.report.drawing import STYLE

    panels = (
        ("time of a keyframe (ms)", ("query_ms", "covisible_ms", "local_map_ms")),
        ("time after a loop (s)", ("graph_s", "optimise_s", "prepare_s", "iteration_s")),
        ("memory (MB)", ("map_mb", "words_mb", "mb")),
    )
    titles = {key: title for _, key, title, _ in ROWS}
    titles |= {"mb": "global bundle adjustment", "prepare_s": "bundle adjustment, prepared"}
    titles |= {"iteration_s": "bundle adjustment, an iteration"}
    titles |= {"optimise_s": "pose graph, optimised"}
    with style.context(STYLE, after_reset=True):
        figure = Figure(figsize=(11, 3.6), layout="constrained")
        for axes, (title, keys) in zip(figure.subplots(1, 3), panels, strict=True):
            for key in keys:
                known = [(n, figures[key]) for n, figures in found.items() if key in figures]
                exponent = law(found, key).exponent
                label = f"{titles[key].removesuffix(', a keyframe')}: n^{exponent:.2f}"
                axes.loglog(*zip(*known, strict=True), "o-", markersize=3, label=label)
            measured = [n for n, figures in found.items() if figures]
            axes.set_xticks(measured, [f"{n:,}" for n in measured])
            axes.minorticks_off()
            axes.set_xlabel("keyframes")
            axes.set_title(title)
            axes.legend(fontsize=7)
        figure.savefig(path, metadata={"Date": None})


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--sizes", type=int, nargs="+", default=SIZES, help="keyframes")
    parser.add_argument(
        "--memory", type=float, default=8.0, metavar="GB", help="most memory to use"
    )
    parser.add_argument("--figures", type=Path, default=FIGURES, help="file of figures to extend")
    parser.add_argument("--write", type=Path, help="page whose table to replace")
    parser.add_argument("--figure", type=Path)
    parser.add_argument("--simulate", choices=SIMULATIONS, help=argparse.SUPPRESS)
    words = parser.parse_args()
    if words.simulate:
        print(json.dumps(SIMULATIONS[words.simulate](words.sizes[0])))
        return
    found = measure(words.sizes, 1e3 * words.memory, words.figures)
    print(table(found))
    if words.figure:
        draw(found, words.figure)
    if words.write:
        before, rest = words.write.read_text().split(BEGIN)
        words.write.write_text(before + BEGIN + table(found) + END + rest.split(END)[1])


if __name__ == "__main__":
    main()
