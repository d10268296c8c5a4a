"""The commands ``vslam vocabulary ...``, which train, convert and show visual vocabularies."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from vslam.cli.options import Quiet, Seed, option
from vslam.support.errors import InputError, UnreadableImageError, counted
from vslam.support.options import OUTPUT

if TYPE_CHECKING:
    from collections.abc import Iterator

    import numpy as np
    from numpy.typing import NDArray

    from vslam.config import OrbConfig

app = typer.Typer(
    name="vocabulary",
    help="Train, convert and show vocabularies of visual words.",
    no_args_is_help=True,
)


@app.command(
    epilog="[b]Examples[/b]\n  vslam vocabulary train photos kitti/sequences/01/image_0"
    "\n  vslam vocabulary train 'photos/*/*.jpg' --levels 6 --out mine.npz"
)
def train(
    images: Annotated[
        list[str], typer.Argument(metavar="IMAGES", help="Image files, folders or globs.")
    ],
    k: Annotated[int, typer.Option(min=2, max=20, metavar="N", help="Children per node.")] = 10,
    levels: Annotated[
        int,
        typer.Option(min=1, max=10, metavar="N", help="Levels of the tree. It has k^levels words."),
    ] = 5,
    seed: Seed = 0,
    out: Annotated[Path, option(OUTPUT, "FILE", "File to write, .npz or .txt.")] = Path(
        "vocabulary.npz"
    ),
    quiet: Quiet = False,
) -> None:
    """Train a vocabulary on images. They should show many different places."""
    from vslam.cli.console import Console
    from vslam.config import OrbConfig
    from vslam.loopclosure import vocabulary_training
    from vslam.loopclosure.vocabulary_text import is_text, write_vocabulary

    is_text(out)  # refuses an unknown suffix before the work begins
    if not out.parent.is_dir():
        raise InputError(f"{out}: the folder {out.parent} does not exist; create it.")
    paths = _find_images(images)
    descriptors, unreadable = [], 0
    shown = Console(shown=not quiet)
    with shown.count_bar("images", len(paths)) as advance:
        for path, found in zip(paths, _extract_all(paths, OrbConfig()), strict=True):
            if found is None:
                typer.echo(f"{path}: cannot be read as an image; skipped", err=True)
                unreadable += 1
            elif len(found):
                descriptors.append(found)
            advance()
    n = sum(map(len, descriptors))
    shown.announce(f"{n} descriptors of {counted(len(descriptors), 'image')}")

    def on_level(level: int, nodes: int) -> None:
        shown.announce(f"level {level}: {nodes} nodes")

    try:
        trained = vocabulary_training.train(descriptors, k, levels, seed, on_level)
    except ValueError as error:
        raise InputError(
            f"vslam vocabulary train: {error}; {unreadable} of {len(paths)} images cannot be read."
        ) from error
    write_vocabulary(trained, out)
    if not quiet:
        typer.echo(
            f"{out}: {trained.n_words} words from {n} descriptors of "
            f"{counted(len(descriptors), 'image')}, k {k}, levels {levels}, seed {seed}"
        )


@app.command(epilog="[b]Example[/b]\n  vslam vocabulary convert ORBvoc.txt orbvoc.npz")
def convert(
    source: Annotated[
        Path, typer.Argument(metavar="SOURCE", help="Vocabulary, .npz or .txt (DBoW2).")
    ],
    target: Annotated[
        Path, typer.Argument(metavar="TARGET", help="File to write, .npz or .txt (DBoW2).")
    ],
) -> None:
    """Convert a vocabulary between vslam's npz format and the text format of DBoW2 and ORB-SLAM."""
    from vslam.loopclosure.vocabulary_text import is_text, read_vocabulary, write_vocabulary

    is_text(target)
    read = read_vocabulary(source)
    write_vocabulary(read, target)
    typer.echo(f"{target}: {read.n_words} words, {target.stat().st_size / 1e6:.1f} MB")


@app.command()
def info(
    file: Annotated[
        Path | None,
        typer.Argument(
            metavar="FILE", help="Vocabulary, .npz or .txt.", show_default="the shipped vocabulary"
        ),
    ] = None,
) -> None:
    """Show the size and the weights of a vocabulary."""
    import time

    import numpy as np

    from vslam.loopclosure.vocabulary import SHIPPED
    from vslam.loopclosure.vocabulary_text import read_vocabulary

    file = file or SHIPPED
    start = time.perf_counter()
    v = read_vocabulary(file)
    elapsed = time.perf_counter() - start
    depth = v.level[v.word >= 0]
    idf = np.percentile(v.weight, [0, 5, 50, 95, 100])
    rows = [
        ("file", f"{file}: {file.stat().st_size / 1e6:.2f} MB, read in {elapsed * 1e3:.0f} ms"),
        ("tree", f"{v.branching} children at most, {v.levels} levels, {len(v.word)} nodes"),
        ("words", f"{v.n_words}, {np.count_nonzero(v.weight == 0)} of them with weight 0"),
        ("by level", ", ".join(f"{k}: {n}" for k, n in enumerate(np.bincount(depth)) if n)),
        ("idf", "min, 5 %, median, 95 %, max: " + ", ".join(f"{x:.2f}" for x in idf)),
    ]
    for name, value in rows:
        typer.echo(f"{name:<10}{value}")


def _find_images(images: list[str]) -> list[Path]:
    import glob

    from vslam.support.untrusted import is_image

    found: dict[Path, None] = {}
    for name in images:
        path = Path(name)
        if path.is_dir():
            files = sorted(filter(is_image, path.rglob("*")))
        elif path.is_file():
            files = [path]
        else:
            files = sorted(Path(p) for p in glob.glob(name, recursive=True))
        if not files:
            raise InputError(f"{name}: no images found; give files, folders or globs of images.")
        found.update(dict.fromkeys(files))
    return list(found)


def _extract_all(paths: list[Path], config: OrbConfig) -> Iterator[NDArray[np.uint8] | None]:
    """Yield the ``(n, 32)`` ORB descriptors of each image in order, or None if the image cannot be
    read."""
    from concurrent.futures import ThreadPoolExecutor

    from vslam.datasets.image_files import read_grey
    from vslam.frontend.orb import extract
    from vslam.support.machine import available_cores

    def one(path: Path) -> NDArray[np.uint8] | None:
        try:
            return extract(read_grey(path), config).descriptors
        except UnreadableImageError:
            return None

    threads = min(available_cores(), 4)
    with ThreadPoolExecutor(threads) as pool:
        for start in range(0, len(paths), 16 * threads):  # limits the results in memory
            yield from pool.map(one, paths[start : start + 16 * threads])
