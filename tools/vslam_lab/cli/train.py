"""The command ``vslam train``, and the commands ``vslam export`` for networks and training images.

The libraries of the extra ``train`` are imported inside the commands, because ``vslam`` must work
if they are not installed.
"""

from __future__ import annotations

import time
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Literal, get_args

import typer

from vslam.cli.export import app as export
from vslam.cli.options import AllThreads, Quiet, flag, option, require_writable
from vslam.support.errors import InputError, counted, write_file
from vslam.support.options import EXECUTION, INPUT, METHOD, OUTPUT

_TRAIN_EXAMPLES = """
[b]Examples[/b]
  vslam train capsule --data "kitti:~/kitti\\[seq=00,first=250,last=1500]"
  vslam train capsule --data pairs:town1 --data pairs:town2 --preset best
  vslam train capsule --data pairs:town1 --out training/capsule --resume
  vslam train capsule-pruned --weights capsule.safetensors --data pairs:town1
"""
_EXPORT_EXAMPLES = """
[b]Example[/b]
  vslam export onnx --weights training/capsule/capsule.safetensors
"""
_PLACES_EXAMPLES = """
[b]Example[/b]
  vslam export places --data "kitti:~/kitti\\[first=250,last=1500]" --data photos:~/places
"""


app = typer.Typer()


NetworkName = Literal["capsule", "capsule-pruned", "capsule-paper"]
NETWORK_NAMES = get_args(NetworkName)
PresetName = Literal["paper", "best", "pretrained"]
DeviceName = Literal["cpu", "cuda"]
FitName = Literal["squash", "crop"]
DataSources = Annotated[
    list[str],
    option(
        INPUT,
        "KIND:PATH",
        "Source of images: kitti, fabmap, pairs, photos or pack, with options in brackets "
        "(docs/howto/training.md). Repeat the option for several sources.",
        "--data",
    ),
]


@app.command(epilog=_TRAIN_EXAMPLES)
def train(
    network: Annotated[
        NetworkName,
        typer.Argument(
            metavar="NETWORK",
            help=f"Network to train: {', '.join(NETWORK_NAMES)}.",
            show_default=False,
        ),
    ],
    data: DataSources,
    preset: Annotated[
        PresetName,
        option(
            METHOD,
            "NAME",
            "Settings: [b]paper[/b] as published, [b]best[/b], or [b]pretrained[/b], which "
            "starts from ImageNet weights.",
        ),
    ] = "paper",
    settings: Annotated[
        Path | None, option(METHOD, "FILE", "JSON file with settings instead of a preset.")
    ] = None,
    epochs: Annotated[
        int | None,
        option(METHOD, "N", "Largest number of epochs.", min=1, unset="from the settings"),
    ] = None,
    pairs: Annotated[
        int | None,
        option(METHOD, "N", "Pairs of images in each epoch.", min=2, unset="from the settings"),
    ] = None,
    seed: Annotated[
        int | None,
        option(METHOD, "N", "Seed of the random numbers.", min=0, unset="from the settings"),
    ] = None,
    weights: Annotated[
        Path | None,
        option(
            METHOD,
            "FILE",
            "Network to start from. For capsule-pruned and capsule-paper, the network to prune.",
        ),
    ] = None,
    pixels: Annotated[
        str | None, option(METHOD, "SIDE|HxW", "Size of the images. Smaller images train faster.")
    ] = None,
    allow_test_data: Annotated[
        bool,
        flag(METHOD, "Also train on frames that are reserved for tests.", "--allow-test-data"),
    ] = False,
    device: Annotated[DeviceName, option(EXECUTION, "cpu|cuda", "Where to train.")] = "cpu",
    threads: AllThreads = None,
    resume: Annotated[
        bool, flag(EXECUTION, "Resume an interrupted training run in [b]--out[/b].", "--resume")
    ] = False,
    max_minutes: Annotated[
        float | None,
        option(
            EXECUTION, "NUMBER", "Stop after this time. --resume continues the training.", min=0
        ),
    ] = None,
    out: Annotated[
        Path | None,
        option(OUTPUT, "FOLDER", "Folder to write to.", unset="training/NETWORK-PRESET"),
    ] = None,
    quiet: Quiet = False,
) -> None:
    """Train a loop detector.

    The command writes the weights as .safetensors for further training and as .onnx for runs. It
    also writes a log, the pairs, checkpoints and a model card.
    """
    _require_libraries("train")
    from vslam.cli.console import Console
    from vslam.support.machine import available_cores
    from vslam_lab.sources.image_source import parse_size
    from vslam_lab.sources.source_registry import open_source
    from vslam_lab.training.checkpoint import CHECKPOINT
    from vslam_lab.training.data import load, refuse_test_data
    from vslam_lab.training.export import export_onnx
    from vslam_lab.training.initial_network import starting_network
    from vslam_lab.training.model_card import describe, write_card
    from vslam_lab.training.settings import PRESETS, load_settings
    from vslam_lab.training.siamese import load_network
    from vslam_lab.training.training import set_threads
    from vslam_lab.training.training import train as run

    until = None if max_minutes is None else time.monotonic() + 60.0 * max_minutes
    folder = out or Path("training") / f"{network}-{preset}"
    require_writable(folder)
    sources = [source for spec in data for source in open_source(spec)]
    if not allow_test_data:
        refuse_test_data(sources)
    chosen = load_settings(settings) if settings else PRESETS[preset]
    given = {"epochs": epochs, "pairs": pairs, "seed": seed, "network": network}
    chosen = chosen.model_copy(update={k: v for k, v in given.items() if v is not None})
    shape = chosen.shape
    if weights is not None and weights.suffix == ".safetensors" and settings is None:
        shape = load_network(weights)[0].branch.shape
    if pixels is not None:
        shape = shape.for_images_of(parse_size(pixels))
    chosen = chosen.model_copy(update={"shape": shape})
    threads = threads or available_cores()
    set_threads(threads)
    collection = load(sources, chosen.shape.input, chosen.fit, threads)
    start, chosen, report = starting_network(
        chosen, collection, weights, device, resuming=resume and (folder / CHECKPOINT).exists()
    )
    with Console(shown=not quiet).training_bar() as on_step:
        outcome = run(
            collection, chosen, folder, device=device, threads=threads, resume=resume,
            start=start, on_step=on_step,
            should_stop=None if until is None else lambda: time.monotonic() > until,
        )  # fmt: skip
    if outcome.weights.exists():
        trained, about = load_network(outcome.weights)
        name = settings.name if settings else preset
        card = describe(trained, collection, chosen, outcome, preset=name, data=data, device=device)
        write_card({**card, **report}, outcome.weights)
        export_onnx(trained, outcome.weights.with_suffix(".onnx"), about)
    if quiet:
        return
    if not outcome.finished:
        typer.echo(f"{folder}: stopped in epoch {outcome.progress.epoch}; --resume continues")
        return
    for name, value in outcome.figures.items():
        typer.echo(f"{name:<28}{value:.4f}")
    typer.echo(f"{'weights':<28}{outcome.weights}")


def _require_libraries(command: str) -> None:
    """Check that all packages of the extra ``train`` are installed. Otherwise, a missing package
    such as onnxscript would be noticed only after hours of training."""
    for name in ("torch", "safetensors", "onnx", "onnxscript"):
        if find_spec(name) is None:
            raise InputError(
                f"vslam {command}: {name} is not installed; pip install 'vslam[train]'."
            )


@export.command("onnx", epilog=_EXPORT_EXAMPLES)
def onnx(
    weights: Annotated[Path, option(INPUT, "FILE", "Trained weights, .safetensors.")],
    out: Annotated[
        Path | None, option(OUTPUT, "FILE", "File to write.", unset="as --weights, with .onnx")
    ] = None,
) -> None:
    """Write the ONNX file that runs use, and compare its output with the output of torch."""
    _require_libraries("export onnx")
    from vslam_lab.training.export import export_onnx
    from vslam_lab.training.siamese import load_network

    network, about = load_network(weights)
    path = out or weights.with_suffix(".onnx")
    difference = export_onnx(network, path, about)
    typer.echo(
        f"{path}: {path.stat().st_size / 1e6:.1f} MB, grey images of {network.size[0]}x"
        f"{network.size[1]} pixels to descriptors of {network.dimensions} numbers; differs from "
        f"torch by at most {difference:.1e}"
    )


@export.command("weights")
def weights_(
    weights: Annotated[Path, option(INPUT, "FILE", "Trained weights, .safetensors.")],
    out: Annotated[Path, option(OUTPUT, "FILE", "File to write, .safetensors.")],
) -> None:
    """Write weights in the form in which vslam ships them.

    They are in half precision, and a model card and an ONNX file are written with them.
    """
    _require_libraries("export weights")
    from vslam_lab.training.export import export_onnx
    from vslam_lab.training.siamese import load_network, save_network

    network, about = load_network(weights)
    save_network(network, out, about, half=True)
    export_onnx(load_network(out)[0], out.with_suffix(".onnx"), about)
    cards = [weights.with_suffix(end) for end in (".md", ".json")]
    for card in filter(Path.exists, cards):
        write_file(out.with_suffix(card.suffix), card.read_bytes())
    typer.echo(f"{out}: {network.name}, {out.stat().st_size / 1e6:.2f} MB")


@export.command("places", epilog=_PLACES_EXAMPLES)
def places(
    data: DataSources,
    fit: Annotated[
        FitName,
        option(OUTPUT, "squash|crop", "Scale the whole image to the size, or cut out its middle."),
    ] = "squash",
    pixels: Annotated[str, option(OUTPUT, "SIDE|HxW", "Size of the images.")] = "227",
    out: Annotated[Path, option(OUTPUT, "FILE", "File to write.")] = Path("places.npz"),
) -> None:
    """Pack images into one small file for training on another machine."""
    from vslam_lab.sources.image_source import parse_size
    from vslam_lab.sources.pack import write_pack
    from vslam_lab.sources.source_registry import open_source

    sources = [source for spec in data for source in open_source(spec)]
    write_pack(sources, out, parse_size(pixels), fit)
    typer.echo(
        f"{out}: {counted(sum(map(len, sources)), 'image')}, {out.stat().st_size / 1e6:.1f} MB"
    )
