"""The commands ``vslam map ...``."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from vslam.cli.options import Quiet, Thresholds, option, read_thresholds
from vslam.support.errors import InputError, counted
from vslam.support.options import METHOD, OUTPUT

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from vslam.cli.tables import Rows
    from vslam.config import Config
    from vslam.maps.reconstruction import Reconstruction
    from vslam.maps.stored_map import StoredMap
    from vslam.types.map import Map

app = typer.Typer(
    name="map",
    help="Show, merge and crop the maps of runs (docs/howto/maps.md).",
    no_args_is_help=True,
)

Out = Annotated[Path, option(OUTPUT, "FILE", "Map to write. The file must not exist yet.")]
MapFile = Annotated[Path, typer.Argument(metavar="MAP", help="Folder of a run, or a map.npz.")]


@app.command(epilog="[b]Example[/b]\n  vslam map info runs/latest")
def info(
    map_file: MapFile,
) -> None:
    """Show the content of a map: keyframes, landmarks, length, extent and more."""
    from vslam.cli.tables import print_rows
    from vslam.maps.reconstruction import reconstruction_of
    from vslam.maps.storage import load_map, map_file_of

    file = map_file_of(map_file)
    stored = load_map(file)
    map_, camera = stored.map, stored.camera
    reconstruction = reconstruction_of(map_, camera)
    print_rows(
        [
            ("file", f"{file}: {file.stat().st_size / 1e6:.1f} MB"),
            (
                "camera",
                f"{camera.sensor}, {camera.width}x{camera.height}, "
                f"fx {camera.fx:.1f}, fy {camera.fy:.1f}, cx {camera.cx:.1f}, cy {camera.cy:.1f}",
            ),
            *(_contents(map_, reconstruction) if map_.n_keyframes else [("keyframes", "none")]),
            ("sub-maps", _submaps(stored)),
            ("drives", f"{len(stored.drives)}: {', '.join(stored.drives)}"),
            ("loops", str(len(stored.loops))),
            ("detector", stored.detector.name),
        ]
    )


def _submaps(stored: StoredMap) -> str:
    from vslam.method.hypotheses import joined_submaps

    if not stored.map.n_keyframes:
        return "0"
    n_parts = len(set(joined_submaps(stored.map, stored.loops).tolist()))
    split = f", in {n_parts} parts that no loop has joined" if n_parts > 1 else ""
    return f"{len({0, *stored.map.restarts})}{split}"


def _contents(map_: Map, reconstruction: Reconstruction) -> Rows:
    import numpy as np

    r = reconstruction
    path = np.linalg.norm(np.diff(r.T_wc[:, :3, 3], axis=0), axis=1).sum()
    unit = "units" if r.camera.monocular and not map_.scalars.metric else "m"
    observations = f"{len(r.xy)}, {map_.n_rows} keypoints in total"
    if len(r.xy):
        observations += (
            f", {len(r.xy) / len(r.xyz):.1f} per landmark, "
            f"reprojection median {np.median(r.reprojection_errors()):.2f} px"
        )
    return [
        ("keyframes", f"{len(r.frames)}, frames {r.frames.min()} to {r.frames.max()}"),
        ("landmarks", str(len(map_.living_landmarks()))),
        ("observations", observations),
        ("extent", ", ".join(_extent(r.T_wc))),
        ("length", f"{path:.1f} {unit} in {np.ptp(r.timestamps):.1f} s"),
        *_weakest_place(map_),
    ]


def _weakest_place(map_: Map) -> Rows:
    """Return the keyframe that shares the fewest landmarks with earlier keyframes."""
    from vslam.backend.pose_graph import connectivity

    living = map_.living_keyframes()[1:]
    if not len(living):
        return []
    shared = connectivity(map_)[living]
    at = int(shared.argmin())
    landmarks = f"{shared[at]} landmarks shared with earlier keyframes"
    return [("weakest place", f"frame {map_.frames[living[at]]}, {landmarks}")]


def _extent(T_wc: NDArray[np.float64]) -> list[str]:
    low, high = T_wc[:, :3, 3].min(axis=0), T_wc[:, :3, 3].max(axis=0)
    return [f"{axis} {low[i]:.1f} to {high[i]:.1f}" for i, axis in ((0, "x"), (2, "z"))]


@app.command(epilog="[b]Example[/b]\n  vslam map merge runs/monday runs/tuesday --out town.npz")
def merge(
    maps: Annotated[
        list[Path],
        typer.Argument(
            metavar="MAP", help="Maps or folders of runs. The first one defines the world frame."
        ),
    ],
    out: Out,
    config: Thresholds = None,
    weights: Annotated[
        Path | None,
        option(
            METHOD,
            "FILE",
            "Weights or vocabulary of the detector that made the maps.",
            unset="the shipped ones",
        ),
    ] = None,
    quiet: Quiet = False,
) -> None:
    """Merge several maps into one map by verified loops between them.

    Maps without a loop to the other maps are left out, and their names are printed. If no map has a
    loop to the first map, nothing is written, and the exit code is 1. The input files are not
    changed. Without --config, the thresholds of the first map are used.
    """
    from vslam.cli.console import Console
    from vslam.loopclosure.registry import detector_with_images
    from vslam.maps.storage import load_map, map_file_of
    from vslam.method.joining import Memory, join_maps

    if len(maps) < 2:
        raise InputError(f"{maps[0]}: a single map cannot be merged; give two or more.")
    _require_place(out)
    files = [map_file_of(path) for path in maps]
    for number, file in enumerate(files):
        if file.resolve() in [other.resolve() for other in files[:number]]:
            raise InputError(f"{file}: given twice; give each map only once.")
    stored = [load_map(file) for file in files]
    thresholds = _thresholds_of(stored, files) if config is None else read_thresholds(config)
    # Merging need not run in real time, so the network may process all keyframes at once.
    siamese = thresholds.siamese.model_copy(update={"embedded_at_once": sys.maxsize})
    thresholds = thresholds.model_copy(update={"siamese": siamese})
    if not stored[0].map.n_keyframes:
        raise InputError(f"{files[0]}: the map is empty; give another map first.")
    name = stored[0].detector.name
    if name == "none":
        raise InputError(
            f"{files[0]}: was made with the detector none, which finds no loops; give another map "
            "first."
        )

    def create() -> Memory:
        return detector_with_images(name, thresholds, weights)

    keyframes = sum(one.map.n_keyframes for one in stored[1:])
    try:
        with Console(shown=not quiet).count_bar("keyframes", keyframes) as advance:
            merged = join_maps(stored, thresholds, create, advance)
    except ValueError as error:
        raise InputError(f"{files[0]} and the others cannot be merged: {error}.") from error
    if not quiet:
        for number in merged.joined:
            typer.echo(f"{files[number]}: joined by {counted(len(merged.loops[number]), 'loop')}")
    for number in merged.left_out:
        typer.echo(f"{files[number]}: left out, because it has no verified loop to the others")
    if not merged.joined:
        typer.echo("no map has a loop to the first one; nothing was written")
        raise typer.Exit(1)
    _save(out, merged.stored, quiet=quiet)


def _thresholds_of(stored: list[StoredMap], files: list[Path]) -> Config:
    """Return the thresholds of the first map. If other maps have other thresholds, a message lists
    these maps."""
    from vslam.config import as_config

    thresholds = stored[0].thresholds
    others = [
        str(file) for one, file in zip(stored, files, strict=True) if one.thresholds != thresholds
    ]
    if others:
        typer.echo(
            f"{', '.join(others)}: made with other thresholds than {files[0]}, whose thresholds "
            "are used; --config can set others."
        )
    return as_config(thresholds, str(files[0]))


@app.command(
    epilog="[b]Examples[/b]\n  vslam map crop town.npz --box=-50,50,0,200 --out street.npz\n"
    "  vslam map crop town.npz --point 20,140 --within 60 --out crossing.npz\n"
    "  vslam map crop town.npz --frames 300:500 --within 10 --out way.npz"
)
def crop(
    map_file: MapFile,
    out: Out,
    box: Annotated[
        str,
        typer.Option(metavar="X,X,Z,Z", help="Keep keyframes in this range of x and of z."),
    ] = "",
    point: Annotated[
        str,
        typer.Option(metavar="X,Z", help="Keep keyframes --within a distance of this point."),
    ] = "",
    frames: Annotated[
        str,
        typer.Option(
            metavar="FIRST:LAST",
            help="Keep keyframes --within a distance of any keyframe in this range of frames.",
        ),
    ] = "",
    drive: Annotated[
        int,
        typer.Option(
            min=0, metavar="N", help="Number of the drive that [b]--frames[/b] refers to."
        ),
    ] = 0,
    within: Annotated[
        float,
        typer.Option(
            min=0.0,
            metavar="NUMBER",
            help="Distance in metres, or in map units for a monocular map.",
        ),
    ] = 0.0,
) -> None:
    """Cut out a part of a map.

    The result contains the chosen keyframes and the landmarks that they observe. The axis x points
    to the right of the first camera, and z points ahead. The height is ignored.
    """
    from vslam.maps.storage import load_map, map_file_of
    from vslam.maps.stored_map import in_box, near_frames, near_point

    if sum(map(bool, (box, point, frames))) != 1:
        raise InputError("--box, --point, --frames: give exactly one of them.")
    _require_place(out)
    file = map_file_of(map_file)
    stored = load_map(file)
    if box:
        kept = in_box(stored.map, _numbers("--box", box, 4))
    elif point:
        kept = near_point(stored.map, _numbers("--point", point, 2), within)
    else:
        first, last = _numbers("--frames", frames, 2, separator=":")
        kept = near_frames(stored.map, drive, first, last, within)
    if not len(kept):
        raise InputError(f"{file}: has no keyframe there; 'vslam map info' shows its extent.")
    _save(out, stored.select(kept))


def _numbers(option: str, text: str, n: int, separator: str = ",") -> list[float]:
    try:
        numbers = [float(word) for word in text.split(separator)]
    except ValueError:
        numbers = []
    if len(numbers) != n:
        raise InputError(f"{option} {text}: must be {n} numbers with '{separator}' between them.")
    return numbers


def _require_place(out: Path) -> None:
    from vslam.maps.new_output import require_free, require_place

    require_free(out)
    require_place(out, "--out")


def _save(out: Path, stored: StoredMap, *, quiet: bool = False) -> None:
    from vslam.maps.new_output import new_output
    from vslam.maps.storage import save_map

    with new_output(out) as file:
        save_map(file, stored)
    if not quiet:
        map_ = stored.map
        keyframes = counted(map_.n_keyframes, "keyframe")
        typer.echo(f"{out}: {keyframes}, {counted(map_.n_landmarks, 'landmark')}")
