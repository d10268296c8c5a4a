"""The systems and the data that are tested by ``vslam bench`` and ``vslam stress``.

These commands perform a grid of runs. Each cell of the grid is one run of a system on a sequence,
with a perturbation and a random seed.
"""

from __future__ import annotations

import shlex
import sys
from collections.abc import Collection, Generator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from vslam.cli.console import Console
from vslam.cli.options import kind_of_source, names_in, open_given, read_thresholds
from vslam.support.errors import InputError, did_you_mean
from vslam.support.options import with_paths, words_of

if TYPE_CHECKING:
    from vslam.datasets.frames import Source
    from vslam.types.source_options import SourceOptions
    from vslam_lab.bench.execute import CellOptions, CellOutcome
    from vslam_lab.bench.grid import Cell

_ORBSLAM3 = "orbslam3"


@dataclass(frozen=True)
class Systems:
    """The SLAM systems that a benchmark tests.

    Attributes:
        detectors: loop detectors of vslam.
        weights: the weight file of each detector. Detectors that use the shipped weights are not
            included.
        others: the command template of each other system, by name of the system
            (``vslam_lab.stress.external``).
    """

    detectors: list[str]
    weights: dict[str, Path]
    others: dict[str, str]

    @property
    def names(self) -> list[str]:
        """Names of the detectors, followed by the names of the other systems."""
        return [*self.detectors, *self.others]


def choose_systems(
    detectors: str,
    weights: Collection[str],
    systems: str,
    given: Collection[str],
    python: Path | None,
    vocabulary: Path | None,
) -> Systems:
    from vslam.loopclosure.registry import parse_weights, require_detector

    wanted = names_in(systems)
    others = _command_templates(wanted, given, python, vocabulary)
    chosen = names_in(detectors) if "vslam" in wanted else []
    files = parse_weights(weights, chosen)
    for name in chosen or [""] * ("vslam" in wanted):
        require_detector(name, files.get(name), option="--detectors")
    if clash := [name for name in chosen if name in others]:
        raise InputError(
            f"--system {clash[0]}: a detector of this test has the same name; choose another."
        )
    if not chosen and not others:
        raise InputError("--systems: is empty; give vslam, orbslam3 or a name of --system.")
    return Systems(chosen, files, others)


def _command_templates(
    wanted: list[str], given: Collection[str], python: Path | None, vocabulary: Path | None
) -> dict[str, str]:
    from vslam_lab.stress import orbslam3
    from vslam_lab.stress.external import check_template

    templates: dict[str, str] = {}
    for text in given:
        name, separator, command = text.partition("=")
        if not (name and separator):
            raise InputError(f"--system {text}: write NAME=COMMAND.")
        check_template(name, command)
        templates[name] = command
    if _ORBSLAM3 in wanted and _ORBSLAM3 not in templates:
        if vocabulary is None or not vocabulary.is_file():
            raise InputError(
                "--systems orbslam3: give its vocabulary in DBoW2's text format with --vocabulary."
            )
        interpreter = python or Path(sys.executable)
        if not interpreter.exists():
            raise InputError(f"--orbslam3-python {interpreter}: no such file; give an interpreter.")
        words = [interpreter.absolute(), Path(orbslam3.__file__), vocabulary.absolute()]
        templates[_ORBSLAM3] = f"{shlex.join(map(str, words))} {{folder}} {{out}}"
    for name in wanted:
        if name != "vslam" and name not in templates:
            raise InputError(
                f"--systems {name}: unknown{did_you_mean(name, ('vslam', _ORBSLAM3, *templates))}; "
                f"give vslam or orbslam3, or add --system {name}=COMMAND."
            )
    return {name: templates[name] for name in [*wanted, *templates] if name in templates}


@dataclass(frozen=True)
class Cells:
    """The sequences and settings of a benchmark, which is a grid of runs (cells).

    Attributes:
        kind: kind of data, which is a value of the option ``--dataset``.
        given: options that describe the data. Paths are absolute, because each run has its own
            working folder.
        systems: the systems to test.
        sequences: the opened sequences by name.
        options: settings that are the same for all runs.
        jobs: number of runs that this machine performs at the same time.
        scheduler: address of a Dask scheduler whose workers perform the runs. None if this machine
            performs the runs.
        out: folder of the results.
        console: shows the progress in the terminal.
    """

    kind: str
    given: SourceOptions
    systems: Systems
    sequences: dict[str, Source]
    options: CellOptions
    jobs: int
    scheduler: str | None
    out: Path
    console: Console

    def grid(self, perturbations: Collection[str], seeds: int) -> list[Cell]:
        """Return the runs of the benchmark. Each run is one system on one sequence, with a
        perturbation and a random seed.

        Args:
            perturbations: the perturbations to apply to the sequences.
            seeds: number of random seeds.
        """
        from vslam_lab.bench.grid import make_grid, thresholds_digest

        return make_grid(
            self.kind, self.sequences, perturbations, self.systems.names, seeds,
            self.given.max_frames, self.systems.weights, sensor=self.given.sensor,
            calib=tuple(map(str, self.given.calib)),
            thresholds=thresholds_digest(self.options.config), repeated=self.systems.others,
        )  # fmt: skip

    def prepare(self) -> None:
        """Create the folder of the results."""
        from vslam_lab.bench.execute import prepare

        prepare(self.out, _identity(self.kind, self.given))

    def run(self, cells: Collection[Cell]) -> Generator[CellOutcome, None, None]:
        """Perform the given runs, and yield their outcomes. They are performed by Dask workers if
        the option ``--scheduler`` was given, and otherwise on this machine."""
        if self.scheduler is not None:
            from vslam_lab.bench.cluster import run_on_cluster

            return run_on_cluster(cells, self.options, self.scheduler, self.out)
        from vslam.run.warmup import compile_kernels, is_cold
        from vslam_lab.bench.execute import run_here

        if cells and is_cold():  # compiled once here, not in each run
            self.console.announce("first run: compiling the kernels, about a minute ...")
            compile_kernels()
        return run_here(cells, self.options, self.jobs, self.out)


def open_cells(
    given: SourceOptions,
    seqs: str | None,
    systems: Systems,
    config: str | None,
    threads: int | None,
    jobs: int,
    scheduler: str | None,
    out: Path,
    *,
    shown: bool,
) -> Cells:
    """Open the sequences of a benchmark.

    Args:
        seqs: list of sequences, such as "00-05" or "00,demo". None for data that has only one
            sequence.
    """
    from vslam.support.machine import available_cores
    from vslam_lab.bench.execute import CellOptions, scratch_folder

    out, console = out.absolute(), Console(shown=shown)
    kind = kind_of_source(given)
    given = _absolute(given)
    opened = _open_all(kind, given, seqs, console)
    if systems.others and not all(source.seekable for source in opened.values()):
        raise InputError(
            f"--systems {next(iter(systems.others))}: other systems read KITTI's format, which "
            "vslam can write only from data sets and folders of images; extract the images, or "
            "test vslam alone."
        )
    program = (sys.executable, "-m", "vslam_lab.cli.child", "foreign")
    options = CellOptions(
        data=Path(given.data) if kind != "synthetic" else None,
        config=read_thresholds(config).model_dump_json(indent=2)
        + "\n",  # in the form in which a run writes it
        threads=threads or max(1, min(available_cores() // jobs, 4)),
        scratch=None if scheduler else scratch_folder(out),
        others={name: (*program, name, command) for name, command in systems.others.items()},
        source=tuple(words_of(given, _OF_A_RUN)),
    )
    return Cells(kind, given, systems, opened, options, jobs, scheduler, out, console)


def _absolute(given: SourceOptions) -> SourceOptions:
    paths = with_paths(given, Path.absolute)
    if given.data and Path(given.data).exists():
        paths["data"] = str(Path(given.data).absolute())
    return given.model_copy(update=paths)


# Each run has its own values of these options.
_OF_A_RUN = ("data", "dataset", "seq", "calib", "sensor", "start", "every", "max_frames")


def _identity(kind: str, given: SourceOptions) -> str:
    """Return a text that identifies the data of a benchmark."""
    if kind != "synthetic":
        return " ".join([given.data, *words_of(given, _OF_A_RUN), *map(str, given.calib)])
    from vslam_lab.towns import Variation, store

    return f"rendered towns {store.folder_name(Variation())}"


def _open_all(
    kind: str, given: SourceOptions, seqs: str | None, console: Console
) -> dict[str, Source]:
    """Open every sequence, so that missing data are reported before the first run.

    Synthetic sequences are rendered here, so that parallel runs do not render the same sequence.
    """
    from vslam.types.source_options import LIVE
    from vslam_lab.bench.grid import parse_sequences

    named = f"--data {given.data}" if given.data else f"--dataset {kind}"
    once = f"{named}: a live camera cannot be repeated; record a video or a bag."
    if kind in LIVE:
        raise InputError(once)
    opened = {}
    for name in [None] if seqs is None else parse_sequences(seqs):
        source = open_given(given.model_copy(update={"dataset": kind, "seq": name}), console)
        if source.live:
            raise InputError(once)
        opened[name or source.name] = source
    return opened
