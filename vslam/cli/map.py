"""The commands ``vslam map ...``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from vslam.cli.summary import Rows
    from vslam.map import Map
    from vslam.maps.reconstruction import Reconstruction

commands = typer.Typer(help="Look at the maps of runs.", no_args_is_help=True)


def register(app: typer.Typer) -> None:
    """Add the commands to the application."""
    app.add_typer(commands, name="map")


@commands.command(epilog="[b]Example[/b]\n\n  vslam map info runs/latest")
def info(
    run: Annotated[Path, typer.Argument(metavar="RUN|FILE", help="Folder of a run, or a map.npz.")],
) -> None:
    """Show what a map holds: keyframes, landmarks, observations, length, sub-maps, sizes."""
    from vslam.cli.summary import print_rows
    from vslam.maps.reconstruction import reconstruction_of
    from vslam.maps.storage import load_map

    file = run / "map.npz" if run.is_dir() else run
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
            ("sub-maps", str(len({0, *map_.restarts}) if map_.n_keyframes else 0)),
            ("drives", f"{len(stored.drives)}: {', '.join(stored.drives)}"),
            ("loops", str(len(stored.loops))),
            ("detector", stored.detector.name),
        ]
    )


def _contents(map_: Map, reconstruction: Reconstruction) -> Rows:
    import numpy as np

    r = reconstruction
    path = np.linalg.norm(np.diff(r.T_wc[:, :3, 3], axis=0), axis=1).sum()
    unit = "units" if r.camera.monocular else "m"
    observations = f"{len(r.xy)} by {map_.n_rows} keypoints"
    if len(r.xy):
        observations += (
            f", {len(r.xy) / len(r.xyz):.1f} of a landmark, "
            f"reprojection median {np.median(r.reprojection_errors()):.2f} px"
        )
    return [
        ("keyframes", f"{len(r.frames)}, frames {r.frames.min()} to {r.frames.max()}"),
        ("landmarks", str(len(map_.living_landmarks()))),
        ("observations", observations),
        ("length", f"{path:.1f} {unit} in {np.ptp(r.timestamps):.1f} s"),
    ]
