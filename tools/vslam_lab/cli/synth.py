"""The command ``vslam synth``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from vslam.cli.options import Quiet, Threads, flag, option
from vslam.support.errors import InputError, counted
from vslam.support.options import OUTPUT

_EXAMPLES = """
[b]Examples[/b]
  vslam synth --list
  vslam synth 05 --change 0.5 --dynamic 6
  vslam synth mine --trajectory poses/07.txt --calibration 04-12
  vslam synth block --side-by-side block.mkv
  vslam synth room --imu --seed 3
  vslam synth block --fisheye --out fisheye
  vslam synth demo --rgbd --out rgbd
  vslam synth demo --pairs 1000 --aliased --change 0.8 --out pairs
  vslam synth 05 --pairs 500 --lateral=-3.2:1.4 --heading 0:30 --out pairs
"""
_DRIVE, _TOWN, _PAIRS = "Drive", "Town", "Pairs of images"  # names of panels of --help


app = typer.Typer()


@app.command(epilog=_EXAMPLES)
def synth(
    route: Annotated[
        str,
        typer.Argument(
            metavar="ROUTE", help="Built-in route, or a name for the route of --trajectory."
        ),
    ] = "",
    trajectory: Annotated[
        Path | None,
        option(_DRIVE, "FILE", "Poses to drive along, in KITTI's format, 10 per second."),
    ] = None,
    calibration: Annotated[
        str,
        option(
            _DRIVE, "00-02|03|04-12", "With --trajectory: use the cameras of these KITTI sequences."
        ),
    ] = "00-02",
    max_frames: Annotated[
        int | None,
        option(
            _DRIVE,
            "N",
            "Stop after N frames. A later command can render the remaining frames.",
            min=1,
            unset="all",
        ),
    ] = None,
    seed: Annotated[int, option(_TOWN, "N", "Seed of the random numbers.", min=0)] = 0,
    aliased: Annotated[
        bool, flag(_TOWN, "Repeat a few facades, so that places look alike.", "--aliased")
    ] = False,
    dynamic: Annotated[int, option(_TOWN, "N", "Number of moving cars.", min=0)] = 0,
    change: Annotated[
        float,
        option(
            _TOWN,
            "0-1",
            "How much the town changes between two passes. Above 0.7, it gets dark.",
            min=0,
            max=1,
        ),
    ] = 0.0,
    depth: Annotated[
        bool, flag(OUTPUT, "Also write 16-bit depth images in centimetres.", "--depth")
    ] = False,
    imu: Annotated[
        bool,
        flag(
            OUTPUT,
            "Also write imu.csv, the samples of an IMU on the camera at 200 Hz, and "
            "calibration.yaml.",
            "--imu",
        ),
    ] = False,
    side_by_side: Annotated[
        Path | None,
        option(
            OUTPUT,
            "VIDEO",
            "Also write a lossless video with both images in each frame, and its calibration.",
        ),
    ] = None,
    fisheye: Annotated[
        bool,
        flag(
            OUTPUT,
            "Write unrectified fisheye images in EuRoC's layout, with Kalibr's camchain.yaml.",
            "--fisheye",
        ),
    ] = False,
    rgbd: Annotated[
        bool,
        flag(
            OUTPUT,
            "Write images with depth in TUM's layout, in addition to the stereo pairs.",
            "--rgbd",
        ),
    ] = False,
    pairs: Annotated[
        int,
        option(
            _PAIRS, "N", "Render N labelled pairs of training images instead of a drive.", min=0
        ),
    ] = 0,
    lateral: Annotated[
        str,
        option(
            _PAIRS,
            "LOW:HIGH",
            "Range of the offset of the second view to the right, in metres. At -3.2, it is in the "
            "opposite lane.",
        ),
    ] = "-1.4:1.4",
    heading: Annotated[
        str,
        option(_PAIRS, "LOW:HIGH", "Range of the angle between the two views, in degrees."),
    ] = "0:14",
    out: Annotated[
        Path | None, option(OUTPUT, "FOLDER", "Folder to write to.", unset="the user's cache")
    ] = None,
    list_: Annotated[
        bool,
        flag(OUTPUT, "Only list the routes and what has been rendered.", "--list"),
    ] = False,
    clean: Annotated[
        bool, flag(OUTPUT, "Delete the rendered images of ROUTE, or of all routes.", "--clean")
    ] = False,
    verify: Annotated[
        bool, flag(OUTPUT, "Verify all checksums and render damaged frames again.", "--verify")
    ] = False,
    threads: Threads = None,
    quiet: Quiet = False,
) -> None:
    """Render a drive through a town, or a flight through a hall, with exact ground truth."""
    from vslam.cli.console import Console
    from vslam.support.machine import available_cores
    from vslam.types.trajectory import read_kitti_poses
    from vslam_lab.towns import (
        DRIVES,
        MOTIONS,
        ROUTES,
        Variation,
        parse_drive,
        route_named,
        route_of_poses,
        store,
    )
    from vslam_lab.towns.inertial import write_imu

    cache = out or store.cache_folder()
    town = Variation()
    if trajectory is None and route in DRIVES:
        route, town = parse_drive(route)
    if list_:
        for name, about in (ROUTES | MOTIONS).items():
            typer.echo(f"{name:<6}{about}")
        for name, drive_of in DRIVES.items():
            typer.echo(f"{name:<6}the drive {drive_of}")
        for found in store.list_stored(cache):
            state = "complete" if found.complete else "incomplete"
            folder = found.root / "sequences" / found.name
            typer.echo(
                f"{folder}: {counted(found.frames, 'frame')}, {found.size / 1e6:.0f} MB, {state}"
            )
        return
    if clean:
        freed = store.clean(cache, route or None)
        if not quiet:
            typer.echo(f"{cache}: {freed / 1e6:.0f} MB removed")
        return
    if side_by_side is not None and (pairs or fisheye):
        raise InputError("--side-by-side: writes a sequence; leave out --pairs and --fisheye.")
    if not route:
        known = ", ".join(ROUTES | MOTIONS)
        raise InputError(f"vslam synth: give a route, one of {known}, or --list.")
    variation = Variation(
        seed or town.seed, aliased or town.aliased, change or town.change, dynamic or town.moving
    )
    drive = (
        route_named(route, variation)
        if trajectory is None
        else route_of_poses(read_kitti_poses(trajectory), route, calibration)
    )
    if imu and (fisheye or rgbd or pairs):
        raise InputError("--imu: leave out --fisheye, --rgbd and --pairs.")
    for form, given in (("--fisheye", fisheye), ("--rgbd", rgbd)):
        if given and (depth or pairs or verify or fisheye == rgbd):
            raise InputError(
                f"{form}: leave out --depth, --pairs and --verify, and one of --fisheye and --rgbd."
            )
    ranges = _range("--lateral", lateral, -4.0, 4.0), _range("--heading", heading, 0.0, 45.0)
    threads = threads or min(available_cores(), 4)
    with Console(shown=not quiet).render_bar() as on_frame:
        if pairs:
            from vslam_lab.towns.pairs import Moves, render_pairs

            root = out or Path("pairs")
            moves = Moves(*ranges)
            render_pairs(drive, variation, root, pairs, moves, threads=threads, on_frame=on_frame)
        elif fisheye or rgbd:
            from vslam_lab.towns.fisheye import render_fisheye
            from vslam_lab.towns.layouts import render_rgbd

            render, form = (render_fisheye, "fisheye") if fisheye else (render_rgbd, "rgbd")
            target = out or Path(f"{route}-{form}")
            root = render(
                drive, variation, target, until=max_frames, threads=threads, on_frame=on_frame
            )
        else:
            root = store.render_sequence(
                drive,
                variation,
                cache,
                depth=depth,
                until=max_frames,
                verify=verify,
                threads=threads,
                on_frame=on_frame,
            )
    if imu:
        write_imu(drive, variation.seed, root / "sequences" / route)
    if side_by_side is not None:
        from vslam.datasets.kitti import open_kitti
        from vslam_lab.towns.layouts import write_side_by_side

        frames = open_kitti(root, drive.name, max_frames=max_frames)
        calibration_file = write_side_by_side(frames, side_by_side)
        if not quiet:
            typer.echo(
                f"{side_by_side}: {counted(len(frames), 'frame')}, calibration in "
                f"{calibration_file}"
            )
    if not quiet:
        typer.echo(f"{root}: " + (counted(pairs, "pair") if pairs else f"sequence {route}"))


def _range(option: str, given: str, least: float, most: float) -> tuple[float, float]:
    low, _, high = given.partition(":")
    try:
        found = float(low), float(high)
    except ValueError as error:
        raise InputError(f"{option} {given}: must be LOW:HIGH, two numbers.") from error
    if not least <= found[0] <= found[1] <= most:
        raise InputError(
            f"{option} {given}: must be two ascending numbers from {least:g} to {most:g}."
        )
    return found
