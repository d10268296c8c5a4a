"""The commands ``vslam export ...`` for maps. ``train.py`` adds the commands for networks."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from vslam.cli.options import Quiet, flag, option
from vslam.support.errors import InputError, counted
from vslam.support.options import INPUT, OUTPUT

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    import numpy as np
    from numpy.typing import NDArray

    from vslam.backend.pose_graph import PoseGraph
    from vslam.datasets.frames import TimedFrame
    from vslam.maps.reconstruction import Reconstruction
    from vslam.maps.stored_map import StoredMap
    from vslam.report.finished_run import FinishedRun
    from vslam.types.map import Map

    Colours = NDArray[np.uint8]

app = typer.Typer(
    name="export",
    help="Export maps for other programs (docs/howto/exports.md), trained networks, and training "
    "images.",
    no_args_is_help=True,
)

Run = Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a run, like runs/latest.")]
RunOrFile = Annotated[
    Path, typer.Argument(metavar="RUN|FILE", help="Folder of a run, or a map.npz.")
]
Data = Annotated[
    str | None,
    option(
        INPUT,
        "DATA",
        "New location of the images of the run, if they were moved.",
        unset="the location from which the run read them",
    ),
]
Link = Annotated[
    bool, flag(OUTPUT, "Link to the images of the data set instead of copying them.", "--link")
]

Level = Annotated[
    bool,
    flag(
        OUTPUT,
        "Turn the world until its z axis points up, along the gravity that an IMU has measured.",
        "--level",
    ),
]


def _out(default: str) -> typer.models.OptionInfo:
    is_file = "." in default
    return option(
        OUTPUT,
        "FILE" if is_file else "FOLDER",
        f"{'File' if is_file else 'Folder'} to write{'' if is_file else ' to'}.",
        "--out",
        unset=f"RUN/{default}",
    )


@app.command(epilog="[b]Example[/b]\n  vslam export colmap runs/latest")
def colmap(
    run: Run,
    data: Data = None,
    out: Annotated[Path | None, _out("colmap")] = None,
    text: Annotated[
        bool, flag(OUTPUT, "Write text files instead of binary files.", "--text")
    ] = False,
    link: Link = False,
    level: Level = False,
    quiet: Quiet = False,
) -> None:
    """Write the images of keyframes and a sparse model in COLMAP's format."""
    from vslam.maps.colmap import save_colmap
    from vslam.maps.level import turned

    T_level_world = _level_world(run) if level else None

    def save(folder: Path, model: Reconstruction, names: list[str], colours: Colours) -> None:
        sparse = folder / "sparse" / "0"
        sparse.mkdir(parents=True)
        model = model if T_level_world is None else turned(model, T_level_world)
        save_colmap(sparse, model, names, colours, text=text)

    _export_images(run, data, out or run / "colmap", save, link=link, quiet=quiet)


@app.command(epilog="[b]Example[/b]\n  vslam export nerfstudio runs/latest")
def nerfstudio(
    run: Run,
    data: Data = None,
    out: Annotated[Path | None, _out("nerfstudio")] = None,
    link: Link = False,
    level: Level = False,
    quiet: Quiet = False,
) -> None:
    """Write the images of keyframes, their poses and the landmarks for nerfstudio."""
    from vslam.maps.formats import save_nerfstudio
    from vslam.maps.level import T_UPRIGHT_CAMERA

    T_saved_world = _level_world(run) if level else T_UPRIGHT_CAMERA

    def save(folder: Path, model: Reconstruction, names: list[str], colours: Colours) -> None:
        images = [f"images/{name}" for name in names]
        save_nerfstudio(folder, model, images, colours, T_saved_world)

    _export_images(run, data, out or run / "nerfstudio", save, link=link, quiet=quiet)


@app.command(epilog="[b]Example[/b]\n  vslam export ply runs/latest")
def ply(
    run: RunOrFile,
    data: Data = None,
    out: Annotated[Path | None, _out("landmarks.ply")] = None,
    colours: Annotated[
        bool,
        flag(
            OUTPUT,
            "Whether to colour the landmarks. This needs the images of the run.",
            "--colours/--no-colours",
        ),
    ] = True,
    level: Level = False,
    quiet: Quiet = False,
) -> None:
    """Write the landmarks as a point cloud. The colours are taken from the images."""
    from vslam.maps.formats import landmark_colours, save_ply
    from vslam.maps.level import turned
    from vslam.maps.new_output import new_output

    if run.is_file():
        if colours:
            raise InputError(
                f"{run}: a map file gives no images for the colours; give --no-colours, or "
                "the folder of a run."
            )
        reconstruction = _reconstruction_of_file(run)
    else:
        finished, reconstruction = _read(run)
    target = out or _beside(run, "landmarks.ply")
    with new_output(target) as file:
        seen = None
        if colours:
            frames = _keyframes(finished, data, quiet=quiet)
            seen = landmark_colours(reconstruction, map(_image_of, frames))
        shown = turned(reconstruction, _level_world(run)) if level else reconstruction
        save_ply(file, shown.xyz, seen)
    _say(target, reconstruction, quiet=quiet)


@app.command(epilog="[b]Example[/b]\n  vslam export g2o runs/latest")
def g2o(
    run: RunOrFile,
    out: Annotated[Path | None, _out("pose_graph.g2o")] = None,
    level: Level = False,
    quiet: Quiet = False,
) -> None:
    """Write the pose graph: poses of keyframes, odometry and loop edges, and information
    matrices."""
    import numpy as np

    from vslam.backend.pose_graph import LOOP
    from vslam.maps.formats import save_g2o
    from vslam.maps.new_output import new_output
    from vslam.types.geometry import inverses

    graph, map_ = _graph(run)
    ids = graph.keyframes  # frame numbers repeat in a map of several drives
    if len(set(map_.sessions)) == 1:
        ids = map_.frames[ids]
    T_wc = inverses(graph.T_cw)
    if level:
        T_wc = _level_world(run) @ T_wc
    target = out or _beside(run, "pose_graph.g2o")
    with new_output(target) as file:
        save_g2o(file, ids, T_wc, graph.edges, graph.T_i_j, graph.sigmas)
    if not quiet:
        loops = np.count_nonzero(graph.kind == LOOP)
        typer.echo(f"{target}: {len(ids)} vertices, {len(graph.edges)} edges, {loops} from loops")


@app.command(epilog="[b]Example[/b]\n  vslam export euroc runs/latest")
def euroc(
    run: Run,
    out: Annotated[Path | None, _out("trajectory_euroc.csv")] = None,
    level: Level = False,
    quiet: Quiet = False,
) -> None:
    """Write the trajectory in EuRoC's CSV format.

    Every run writes its trajectory in the formats of TUM and KITTI, too.
    """
    from dataclasses import replace

    from vslam.maps.new_output import new_output
    from vslam.types.trajectory import read_trajectory, write_euroc

    trajectory = read_trajectory(run / "trajectory.tum")
    if level:
        trajectory = replace(trajectory, T_wc=_level_world(run) @ trajectory.T_wc)
    target = out or run / "trajectory_euroc.csv"
    with new_output(target) as file:
        write_euroc(file, trajectory)
    if not quiet:
        typer.echo(f"{target}: {counted(len(trajectory), 'pose')}")


@app.command(epilog="[b]Example[/b]\n  vslam export ros runs/latest")
def ros(
    run: Run,
    out: Annotated[Path | None, _out("ros.mcap")] = None,
    online: Annotated[
        bool,
        flag(
            OUTPUT,
            "Use the poses at the time of tracking, not the final poses. Then, map -> odom jumps "
            "at loops, as it did during the drive.",
            "--online",
        ),
    ] = False,
    quiet: Quiet = False,
) -> None:
    """Write odometry, transforms, path and landmarks as ROS 2 messages in an MCAP file."""
    import numpy as np

    from vslam.maps.new_output import new_output
    from vslam.maps.ros import frame_poses, save_bag
    from vslam.maps.storage import load_map
    from vslam.report.frame_table import read_covariances
    from vslam.types.trajectory import read_trajectory

    target = out or run / "ros.mcap"
    if target.suffix != ".mcap":
        raise InputError(f"--out {target}: must end in .mcap, so that ROS recognises the format.")
    trajectory = read_trajectory(run / f"trajectory{'_causal' * online}.tum")
    odometry = read_trajectory(run / "trajectory_odom.tum")
    if not np.array_equal(odometry.timestamps, trajectory.timestamps):
        raise InputError(f"{run}: its trajectories have different frames; repeat the run.")
    covariances = read_covariances(run / "covariance.csv")
    poses = frame_poses(odometry, trajectory, covariances, _gravity(run))
    xyz = np.empty((0, 3))
    if (run / "map.npz").is_file():  # a run that only localises has no map of its own
        map_ = load_map(run).map
        xyz = map_.arrays.xyz[map_.living_landmarks()]
    with new_output(target) as file:
        save_bag(file, poses, trajectory, xyz)
    if not quiet:
        typer.echo(f"{target}: {counted(len(poses), 'pose')}, {counted(len(xyz), 'landmark')}")


def _gravity(run: Path) -> NDArray[np.float64] | None:
    """Return gravity in the world frame of a run or of a map file, or None if it is unknown."""
    import numpy as np

    from vslam.maps.storage import load_map
    from vslam.method.hypotheses import map_gravity
    from vslam.report.schema import ReportJson

    if run.is_file():
        stored = load_map(run)
        return map_gravity(stored.map, stored.loops)
    gravity = ReportJson.read(run / "report.json").gravity
    return None if gravity is None else np.array(gravity)


def _level_world(run: Path) -> NDArray[np.float64]:
    """Return ``(4, 4)`` ``T_level_world`` (``vslam.maps.level``)."""
    from vslam.maps.level import level_world

    gravity = _gravity(run)
    if gravity is None:
        raise InputError(f"{run}: --level needs gravity, which no IMU has measured; leave it out.")
    return level_world(gravity)


def _beside(run: Path, name: str) -> Path:
    """Return the default path of an exported file, in the folder of the run. If ``run`` is a map
    file, the exported file is next to it and has the same stem."""
    return run / name if run.is_dir() else run.with_suffix(Path(name).suffix)


def _graph(run: Path) -> tuple[PoseGraph, Map]:
    """Compute the pose graph of a run or of a map file, and return it with the map.

    The weights of the edges depend on the thresholds of the run. For a map file, the thresholds of
    its last drive are used.
    """
    from vslam.backend.pose_graph import essential_graph
    from vslam.config import as_config, load_config
    from vslam.maps.storage import load_map
    from vslam.report.finished_run import read_run

    stored: StoredMap | FinishedRun
    if run.is_file():
        stored = load_map(run)
        config = as_config(stored.thresholds, str(run))
    else:
        stored, config = read_run(run), load_config(run / "config.json")
    graph = essential_graph(stored.map, stored.loops, config.pose_graph, driven=True)
    return graph, stored.map


def _reconstruction_of_file(path: Path) -> Reconstruction:
    from vslam.maps.reconstruction import reconstruction_of
    from vslam.maps.storage import load_map

    stored = load_map(path)
    return reconstruction_of(stored.map, stored.camera)


def _read(run: Path) -> tuple[FinishedRun, Reconstruction]:
    from vslam.maps.reconstruction import reconstruction_of
    from vslam.report.finished_run import read_run

    finished = read_run(run)
    return finished, reconstruction_of(finished.map, finished.camera)


def _keyframes(finished: FinishedRun, data: str | None, *, quiet: bool) -> Iterator[TimedFrame]:
    from vslam.cli.console import Console
    from vslam.report.finished_run import keyframe_frames, open_images

    console = Console(shown=not quiet)
    with console.render_bar() as on_render:
        source = open_images(finished, data, on_render)
    with console.count_bar("images", len(finished.map.frames)) as advance:
        for frame in keyframe_frames(finished, source):
            yield frame
            advance()


def _export_images(
    run: Path,
    data: str | None,
    target: Path,
    save: Callable[[Path, Reconstruction, list[str], Colours], None],
    *,
    link: bool,
    quiet: bool,
) -> None:
    """Write the images of the keyframes of a run into a new folder. Then call ``save`` with the
    folder, the map, the names of the images and the colours of the landmarks."""
    from vslam.maps.formats import landmark_colours, save_image
    from vslam.maps.new_output import new_output

    finished, reconstruction = _read(run)
    names: list[str] = []

    def saved(images: Path) -> Iterator[NDArray[np.uint8]]:
        frames = _keyframes(finished, data, quiet=quiet)
        for index, frame in zip(reconstruction.frames.tolist(), frames, strict=True):
            image = _image_of(frame)
            if link:
                file = _file_of(frame, finished)
                names.append(f"{index:06d}{file.suffix}")
                (images / names[-1]).symlink_to(file.resolve())
            else:
                names.append(f"{index:06d}.png")
                save_image(image, images / names[-1])
            yield image

    with new_output(target, folder=True) as folder:
        (folder / "images").mkdir()
        colours = landmark_colours(reconstruction, saved(folder / "images"))
        save(folder, reconstruction, names, colours)
    _say(target, reconstruction, quiet=quiet)


def _image_of(frame: TimedFrame) -> NDArray[np.uint8]:
    """Read the left image of a frame, in colour if the source has colour images."""
    return frame.read(map)[0] if frame.colour is None else frame.colour()


def _file_of(frame: TimedFrame, finished: FinishedRun) -> Path:
    if frame.file is None:
        raise InputError(
            f"--link: the images of {finished.report.dataset} are converted when they are read, so "
            "they cannot be linked; leave it out."
        )
    return frame.file


def _say(target: Path, reconstruction: Reconstruction, *, quiet: bool) -> None:
    if not quiet:
        typer.echo(
            f"{target}: {counted(len(reconstruction.frames), 'keyframe')}, "
            f"{counted(len(reconstruction.xyz), 'landmark')}, "
            f"{counted(len(reconstruction.xy), 'observation')}"
        )
