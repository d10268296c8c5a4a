"""The application and its entry point."""

from __future__ import annotations

import gc
import os
import sys
from typing import Annotated

import typer

from vslam.cli import (
    bench,
    doctor,
    evaluate,
    export,
    info,
    loops,
    perturb,
    report,
    run,
    stress,
    synth,
    train,
    vocabulary,
)
from vslam.cli import map as map_
from vslam.errors import InputError, ResultsError
from vslam.machine import keep_memory

app = typer.Typer(
    help="Visual SLAM in pure Python.",
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
)
_GROUPS = (
    run, evaluate, perturb, info, doctor, bench, stress, report, synth, train, export, map_,
    vocabulary, loops,
)  # fmt: skip
for _group in _GROUPS:
    _group.register(app)


@app.callback(invoke_without_command=True)
def version(
    show: Annotated[bool, typer.Option("--version", help="Show the version.")] = False,
) -> None:
    if show:
        from importlib.metadata import version as installed

        typer.echo(installed("vslam"))
        raise typer.Exit


def main() -> None:
    """Entry point: bad input becomes one line on stderr and exit code 2."""
    # Imports and kernels from the cache make a million objects that stay: to look through them for
    # garbage again and again is a tenth of the start.
    gc.set_threshold(50_000, 20, 100)
    keep_memory()
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
