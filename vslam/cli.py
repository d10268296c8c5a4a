"""The command line. Heavy imports stay inside the commands, so that --help answers at once."""

from __future__ import annotations

import gc
import os
import sys
from pathlib import Path
from typing import Annotated

import typer

from vslam import __version__, bench_cli, loops_cli, synth_cli, train_cli, vocabulary_cli
from vslam.console import evaluation_rows, print_rows, print_summary
from vslam.errors import InputError, ResultsError

app = typer.Typer(
    help="Visual SLAM in pure Python.",
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
)
_SENSORS = {"stereo": True, "mono": True, "rgbd": False}

Data = Annotated[
    Path,
    typer.Option(envvar="KITTI_ROOT", help="Folder with the data set, see datasets.md."),
]
Dataset = Annotated[str, typer.Option(help="Data set: [b]kitti[/b] or [b]synthetic[/b].")]
Seq = Annotated[str, typer.Option(help="Sequence, 00 for example.")]
Perturb = Annotated[
    str,
    typer.Option(
        help="Photometric laws, each with a strength, joined by commas: brightness, gamma, "
        "flicker, noise, blur, occlusion. Example: [b]brightness:1.5,blur:0.5[/b]"
    ),
]
Seed = Annotated[int, typer.Option(min=0, help="Seed of all that is random.")]
Start = Annotated[int, typer.Option(min=0, help="First frame.")]
Every = Annotated[int, typer.Option(min=1, help="Take every N-th frame.")]
MaxFrames = Annotated[int | None, typer.Option(min=1, help="Stop after so many frames.")]

_DATA = Path("data/kitti")

_RUN_EXAMPLES = """
[b]Examples[/b]

  vslam run --data ~/kitti --seq 00

  vslam run --data ~/kitti --seq 06 --perturb brightness:1.5,blur:0.5 --seed 3

  vslam run --dataset synthetic --seq demo

  vslam run --seq 00 --max-frames 200 --no-record --quiet
"""


@app.command(epilog=_RUN_EXAMPLES)
def run(
    data: Data = _DATA,
    dataset: Dataset = "kitti",
    seq: Seq = "00",
    perturb: Perturb = "none",
    start: Start = 0,
    every: Every = 1,
    max_frames: MaxFrames = None,
    seed: Seed = 0,
    threads: Annotated[
        int | None,
        typer.Option(
            min=1, help="Threads; the result does not depend on it.", show_default="cores, up to 4"
        ),
    ] = None,
    detector: Annotated[
        str,
        typer.Option(
            help="Loop detector: [b]bow[/b], [b]capsule[/b], capsule-pruned, [b]none[/b] for "
            "odometry only; with [b]--weights[/b] also alexnet, vgg16."
        ),
    ] = "bow",
    weights: Annotated[
        Path | None, typer.Option(help="Safetensors file of a learned detector (vslam train).")
    ] = None,
    sensor: Annotated[
        str,
        typer.Option(help="[b]stereo[/b], or [b]mono[/b]: the left eye alone, scale arbitrary."),
    ] = "stereo",
    out: Annotated[Path, typer.Option(help="Where the folders of the runs go.")] = Path("runs"),
    config: Annotated[
        Path | None, typer.Option(help="JSON file with thresholds, as config.json of a run.")
    ] = None,
    compare_loops: Annotated[
        bool,
        typer.Option("--compare-loops", help="Run again without loop closing; print both."),
    ] = False,
    realtime: Annotated[
        bool,
        typer.Option("--realtime", help="Frames come at their times; overtaken ones drop."),
    ] = False,
    record: Annotated[bool, typer.Option(help="Write a Rerun recording.")] = True,
    pages: Annotated[
        bool,
        typer.Option(
            "--report/--no-report",
            help="Write report.html, report.md and figures; without, of the report only its JSON, "
            "which is all that [b]vslam report[/b] needs of a run.",
        ),
    ] = True,
    ply: Annotated[bool, typer.Option("--ply", help="Write the landmarks as map.ply.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress bar, no summary.")] = False,
) -> None:
    """Run SLAM on a sequence and write trajectory, map, recording and report to a folder."""
    from vslam.detectors import require_detector

    require_detector(detector, weights)
    _require_built("--sensor", sensor, _SENSORS)
    if compare_loops and detector == "none":
        raise InputError("--compare-loops: nothing to compare with --detector none; name another.")
    if compare_loops and realtime:
        raise InputError("--compare-loops: two runs drop different frames; leave out --realtime.")

    from vslam.config import Config, load_config
    from vslam.datasets import open_sequence
    from vslam.info import available_cores
    from vslam.perturb import parse_perturbation
    from vslam.progress import announce, progress_bar, render_bar
    from vslam.run import RunSettings
    from vslam.runfolder import create_run_folder, write_results

    thresholds = Config() if config is None else load_config(config)
    with render_bar(shown=not quiet) as on_render:
        sequence = open_sequence(
            dataset, data, seq,
            start=start, every=every, max_frames=max_frames, monocular=sensor == "mono",
            on_render=on_render,
        )  # fmt: skip
    perturbation = parse_perturbation(perturb, seed, sequence.timestamps)
    folder = create_run_folder(out, dataset, seq, perturbation.name, detector)
    settings = RunSettings(
        dataset=dataset,
        sequence=seq,
        perturb=perturbation.name,
        detector=detector,
        sensor=sensor,
        seed=seed,
        threads=threads or min(available_cores(), 4),
        start=start,
        every=every,
        max_frames=max_frames,
        config=thresholds,
        weights=weights,
        realtime=realtime,
    )
    from vslam.comparison import with_comparison
    from vslam.pipeline import run_sequence
    from vslam.recorder import NullRecorder, RerunRecorder
    from vslam.warmup import compile_kernels, is_cold

    recorder = RerunRecorder(folder / "recording.rrd") if record else NullRecorder()
    if is_cold():
        announce("first run: compiling the kernels, less than a minute ...", shown=not quiet)
    compile_kernels(processes=min(settings.threads, 2))
    with progress_bar(len(sequence), shown=not quiet) as on_frame:
        outcome = run_sequence(sequence, perturbation, settings, recorder, on_frame=on_frame)
    if compare_loops and not outcome.interrupted:
        with progress_bar(len(sequence), shown=not quiet) as on_frame:
            outcome = with_comparison(outcome, perturbation, on_frame=on_frame)
    evaluation, remark = write_results(folder, outcome, pages=pages, ply=ply)
    if not quiet:
        print_summary(outcome, evaluation, remark, folder)
    if outcome.interrupted:
        raise typer.Exit(1)


@app.command(
    "eval",
    epilog="[b]Example[/b]\n\n  vslam eval runs/latest/trajectory_kitti.txt "
    "--gt runs/latest/ground_truth_kitti.txt",
)
def evaluate_files(
    estimate: Annotated[Path, typer.Argument(help="Trajectory, KITTI or TUM format.")],
    gt: Annotated[Path, typer.Option(help="Ground truth, KITTI or TUM format.")],
    align: Annotated[str, typer.Option(help="se3, sim3 (fits the scale too) or none.")] = "se3",
    times: Annotated[
        Path | None, typer.Option(help="times.txt of a KITTI file, to compare it with a TUM file.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Compare a trajectory with the ground truth: ATE, RPE and KITTI drift."""
    import json

    from vslam.evaluate import evaluate, evo_command, read_pair
    from vslam.trajectory import trajectory_format

    trajectory, ground_truth = read_pair(estimate, gt, times)
    evaluation = evaluate(trajectory, ground_truth, align)
    if as_json:
        typer.echo(json.dumps(evaluation.summary(), indent=2))
        return
    matched = f"{evaluation.frames} matched of {len(trajectory)}"
    rows = [("frames", matched), ("alignment", align), *evaluation_rows(evaluation)]
    if trajectory_format(estimate) == trajectory_format(gt):
        rows.append(("reproduce", evo_command(estimate, gt, align)))
    print_rows(rows)


@app.command(
    epilog="[b]Example[/b]\n\n  vslam perturb --seq 00 --perturb brightness:1.5 --out sheet.png"
)
def perturb(
    data: Data = _DATA,
    dataset: Dataset = "kitti",
    seq: Seq = "00",
    perturb: Perturb = "brightness",
    start: Start = 0,
    every: Every = 1,
    max_frames: MaxFrames = None,
    seed: Seed = 0,
    frames: Annotated[int, typer.Option(min=1, help="Frames to show, evenly spread.")] = 8,
    out: Annotated[Path, typer.Option(help="PNG file to write.")] = Path("perturbation.png"),
) -> None:
    """Preview a perturbation: the left eye as it is beside both eyes perturbed."""
    import cv2
    import numpy as np

    from vslam.datasets import open_sequence
    from vslam.perturb import contact_sheet, parse_perturbation

    sequence = open_sequence(dataset, data, seq, start=start, every=every, max_frames=max_frames)
    law = parse_perturbation(perturb, seed, sequence.timestamps)
    shown = np.unique(np.linspace(0, len(sequence) - 1, frames).round().astype(int)).tolist()
    sheet = cv2.imencode(".png", contact_sheet(sequence, law, shown))[1]
    try:
        out.write_bytes(sheet.tobytes())
    except OSError as error:
        raise InputError(
            f"{out}: cannot be written ({error.strerror}); name another file with --out."
        ) from error
    typer.echo(f"{out}: {law.name}, seed {seed}, frames {', '.join(map(str, shown))}")


@app.command()
def info(data: Data = _DATA) -> None:
    """Show versions, cores, compiled kernels and the data found."""
    from vslam import info as machine
    from vslam.datasets.kitti import list_kitti

    found = machine.versions()
    cores = machine.available_cores()
    rows = [*found.items(), ("cores", f"{cores} (--threads {min(cores, 4)} unless given)")]
    rows += [
        ("numba cache", f"{folder}: {size / 2**20:.1f} MB")
        for folder, size in machine.numba_caches().items()
    ]
    try:
        rows += [
            (f"kitti {name}", f"{left} left, {right} right images")
            for name, left, right in list_kitti(data)
        ]
        rows.append(("kitti root", str(data)))
    except InputError as error:
        rows.append(("kitti", str(error)))
    if warning := machine.opencv_conflict(found):
        rows.append(("warning", warning))
    print_rows(rows)


bench_cli.register(app)
synth_cli.register(app)
train_cli.register(app)
vocabulary_cli.register(app)
loops_cli.register(app)


@app.callback(invoke_without_command=True)
def version(
    show: Annotated[bool, typer.Option("--version", help="Show the version.")] = False,
) -> None:
    if show:
        typer.echo(__version__)
        raise typer.Exit


def main() -> None:
    """Entry point: bad input becomes one line on stderr and exit code 2."""
    # Imports and kernels from the cache make a million objects that stay: to look through them for
    # garbage again and again is a tenth of the start.
    gc.set_threshold(50_000, 20, 100)
    # OpenBLAS's threads spin while they wait, and no product of a run is large enough to share.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    try:
        app()
    except InputError as error:
        typer.echo(f"error: {error}", err=True)
        sys.exit(2)
    except ResultsError as error:
        typer.echo(f"error: {error}", err=True)
        sys.exit(1)


def _require_built(option: str, value: str, known: dict[str, bool]) -> None:
    built = ", ".join(f"'{name}'" for name, is_built in known.items() if is_built)
    if value not in known:
        raise InputError(f"{option} {value}: unknown; this version has only {built}.")
    if not known[value]:
        raise InputError(f"{option} {value}: not built yet; this version has only {built}.")
