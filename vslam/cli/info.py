"""The command ``vslam info``."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from vslam.cli.options import kitti_root
from vslam.cli.tables import print_rows
from vslam.support.errors import InputError

app = typer.Typer()


@app.command()
def info(
    data: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER",
            help="Folder with KITTI's data.",
            show_default="$KITTI_ROOT, else data/kitti",
        ),
    ] = None,
) -> None:
    """Show versions, cores, compiled kernels, installed plug-ins, and the KITTI sequences on this
    machine."""
    from vslam.datasets.kitti import list_kitti
    from vslam.support import machine, plugins

    root = Path(kitti_root()) if data is None else data
    versions = machine.versions()
    cores = machine.available_cores()
    rows = [*versions.items(), ("cores", f"{cores} (--threads {min(cores, 4)} unless given)")]
    rows += [
        ("numba cache", f"{folder}: {size / 2**20:.1f} MB")
        for folder, size in _numba_caches().items()
    ]
    try:
        rows += [
            (f"kitti {name}", f"{left} left, {right} right images")
            for name, left, right in list_kitti(root)
        ]
        rows.append(("kitti root", str(root)))
    except InputError as error:
        rows.append(("kitti", str(error)))
    rows += [
        (f"{kind} {name}", ", ".join(plugin.packages))
        for group, kind in plugins.KINDS.items()
        for name, plugin in plugins.find_plugins(group).items()
    ]
    if warning := machine.opencv_conflict(versions):
        rows.append(("warning", warning))
    print_rows(rows)


def _numba_caches() -> dict[Path, int]:
    """Return the folders that contain compiled kernels, and their sizes in bytes."""
    import platformdirs

    import vslam
    import vslam.backend
    import vslam.frontend
    import vslam.loopclosure

    packages = (vslam, vslam.frontend, vslam.loopclosure, vslam.backend)
    roots = [Path(next(iter(package.__path__))) for package in packages]
    folders = [folder for root in roots for folder in sorted(root.rglob("__pycache__"))]
    folders.append(Path(platformdirs.user_cache_dir("numba", appauthor=False)))
    if chosen := os.environ.get("NUMBA_CACHE_DIR"):
        folders.append(Path(chosen))
    sizes = {
        folder: sum(file.stat().st_size for file in folder.rglob("*.nb[ic]")) for folder in folders
    }
    return {folder: size for folder, size in sizes.items() if size}
