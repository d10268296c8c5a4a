"""The command ``vslam synth``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from vslam.errors import InputError

_EXAMPLES = """
[b]Examples[/b]

  vslam synth --list

  vslam synth 05 --change 0.5 --dynamic 6

  vslam synth mine --trajectory poses/07.txt --calibration 04-12

  vslam synth block --side-by-side block.mkv

  vslam synth block --fisheye --out fisheye

  vslam synth demo --rgbd --out rgbd

  vslam synth demo --pairs 1000 --aliased --change 0.8 --out pairs

  vslam synth 05 --pairs 500 --lateral=-3.2:1.4 --heading 0:30 --out pairs
"""


def register(app: typer.Typer) -> None:
    """Add the command to the application."""
    app.command(epilog=_EXAMPLES)(synth)


def synth(
    route: Annotated[str, typer.Argument(help="Built-in route, or a name for --trajectory.")] = "",
    trajectory: Annotated[
        Path | None, typer.Option(help="KITTI poses to drive along, at 10 Hz.")
    ] = None,
    calibration: Annotated[
        str,
        typer.Option(
            metavar="NN",
            help="Camera of which KITTI sequences, with --trajectory: 00-02, 03 or 04-12.",
        ),
    ] = "00-02",
    max_frames: Annotated[
        int | None, typer.Option(min=1, help="Render only so many frames; more can follow later.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the town.")] = 0,
    aliased: Annotated[bool, typer.Option("--aliased", help="Few facades, again and again.")] = (
        False
    ),
    dynamic: Annotated[int, typer.Option(min=0, help="Number of moving cars.")] = 0,
    change: Annotated[
        float,
        typer.Option(min=0, max=1, help="Change between passes; above 0.7 it grows dark."),
    ] = 0.0,
    depth: Annotated[bool, typer.Option("--depth", help="Write 16-bit depth (cm), too.")] = False,
    side_by_side: Annotated[
        Path | None,
        typer.Option(
            metavar="VIDEO",
            help="Write both cameras' images as one video without loss, too, with its calibration.",
        ),
    ] = None,
    fisheye: Annotated[
        bool,
        typer.Option(
            "--fisheye",
            help="Write an unrectified fisheye pair in EuRoC's layout with Kalibr's camchain.yaml.",
        ),
    ] = False,
    rgbd: Annotated[
        bool,
        typer.Option("--rgbd", help="Write images with depth in TUM's layout; stereo/ beside."),
    ] = False,
    pairs: Annotated[
        int, typer.Option(min=0, help="Render so many labelled pairs for training instead.")
    ] = 0,
    lateral: Annotated[
        str,
        typer.Option(
            metavar="LOW:HIGH",
            help="With --pairs: metres that second views are moved to the right; -3.2 is the "
            "other lane.",
        ),
    ] = "-1.4:1.4",
    heading: Annotated[
        str,
        typer.Option(
            metavar="LOW:HIGH", help="With --pairs: degrees that they are turned, to either side."
        ),
    ] = "0:14",
    out: Annotated[
        Path | None, typer.Option(help="Folder to write to.", show_default="user's cache")
    ] = None,
    list_: Annotated[bool, typer.Option("--list", help="List routes and what is rendered.")] = (
        False
    ),
    clean: Annotated[
        bool, typer.Option("--clean", help="Remove what is rendered, of ROUTE or all.")
    ] = False,
    verify: Annotated[
        bool,
        typer.Option("--verify", help="Compare all checksums; render damaged frames again."),
    ] = False,
    threads: Annotated[
        int | None, typer.Option(min=1, help="Threads; the bytes do not depend on it.")
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="No progress bar.")] = False,
) -> None:
    """Render a town in KITTI format, with exact ground truth."""
    from vslam.cli.console import console
    from vslam.datasets.synthetic import (
        DRIVES,
        ROUTES,
        Variation,
        built_in_route,
        parse_drive,
        route_of_poses,
        store,
    )
    from vslam.machine import available_cores
    from vslam.trajectory import read_kitti_poses

    cache = out or store.cache_folder()
    town = Variation()
    if trajectory is None and route in DRIVES:
        route, town = parse_drive(route)
    if list_:
        for name, about in ROUTES.items():
            typer.echo(f"{name:<6}{about}")
        for name, drive_of in DRIVES.items():
            typer.echo(f"{name:<6}the drive {drive_of}")
        for found in store.list_stored(cache):
            state = "complete" if found.complete else "in part"
            folder = found.root / "sequences" / found.name
            typer.echo(f"{folder}: {found.frames} frames, {found.size / 1e6:.0f} MB, {state}")
        return
    if clean:
        freed = store.clean(cache, route or None)
        typer.echo(f"{cache}: {freed / 1e6:.0f} MB removed")
        return
    if side_by_side is not None and (pairs or fisheye):
        raise InputError("--side-by-side: a video of a sequence; leave out --pairs and --fisheye.")
    if not route:
        raise InputError(f"vslam synth: name a route, one of {', '.join(ROUTES)}, or --list.")
    drive = (
        built_in_route(route)
        if trajectory is None
        else route_of_poses(read_kitti_poses(trajectory), route, calibration)
    )
    for option, given in (("--fisheye", fisheye), ("--rgbd", rgbd)):
        if given and (depth or pairs or verify or fisheye == rgbd):
            raise InputError(
                f"{option}: leave out --depth, --pairs, --verify and every other form."
            )
    variation = Variation(
        seed or town.seed, aliased or town.aliased, change or town.change, dynamic or town.moving
    )
    threads = threads or min(available_cores(), 4)
    with console(shown=not quiet).render_bar() as on_frame:
        if pairs:
            from vslam.datasets.synthetic.pairs import Moves, render_pairs

            root = out or Path("pairs")
            moves = Moves(_range("--lateral", lateral, -4.0), _range("--heading", heading, 0.0))
            render_pairs(drive, variation, root, pairs, moves, threads=threads, on_frame=on_frame)
        elif fisheye:
            from vslam.datasets.synthetic.fisheye import render_fisheye

            root = render_fisheye(
                drive,
                variation,
                out or Path(f"{route}-fisheye"),
                until=max_frames,
                threads=threads,
                on_frame=on_frame,
            )
        elif rgbd:
            from vslam.datasets.synthetic.rgbd import render_rgbd

            root = render_rgbd(
                drive,
                variation,
                out or Path(f"{route}-rgbd"),
                until=max_frames,
                threads=threads,
                on_frame=on_frame,
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
    if side_by_side is not None:
        from vslam.datasets.kitti import open_kitti
        from vslam.datasets.synthetic.video import write_side_by_side

        frames = open_kitti(root, drive.name, max_frames=max_frames)
        calibration_file = write_side_by_side(frames, side_by_side)
        typer.echo(f"{side_by_side}: {len(frames)} frames, calibration in {calibration_file}")
    typer.echo(f"{root}: " + (f"{pairs} pairs" if pairs else f"sequence {route}"))


def _range(option: str, given: str, least: float) -> tuple[float, float]:
    low, _, high = given.partition(":")
    try:
        found = float(low), float(high)
    except ValueError as error:
        raise InputError(f"{option} {given}: must be LOW:HIGH, two numbers.") from error
    if not least <= found[0] <= found[1] <= 45.0:
        raise InputError(f"{option} {given}: must not fall, from {least:g} on.")
    return found
