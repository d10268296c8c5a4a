"""The command-line application, and its entry point."""

from __future__ import annotations

import atexit
import gc
import re
import signal
import sys
from collections.abc import Collection
from contextlib import suppress
from functools import cache
from pathlib import Path
from types import FrameType, ModuleType
from typing import Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup

from vslam.cli import calibrate, doctor, evaluate, export, info, perturb, run, vocabulary
from vslam.cli import map as map_
from vslam.support import plugins
from vslam.support.errors import InputError, ResultsError, did_you_mean, plain_reason
from vslam.support.machine import keep_memory, set_up_openblas
from vslam.support.plugins import reason
from vslam.support.untrusted import require_utf8

_GROUPS: tuple[ModuleType, ...] = (
    run, evaluate, perturb, info, calibrate, doctor, export, map_, vocabulary
)  # fmt: skip


_UsageError: Any = typer.BadParameter.__base__  # typer does not export it


class _Command(TyperCommand):
    def format_help(self, ctx: Any, formatter: Any) -> None:
        from vslam.cli.help import show_help

        show_help(self, ctx)

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        try:
            return super().parse_args(ctx, args)
        except typer.BadParameter as error:
            error.message = _plain(error.message)
            raise
        except _UsageError as error:
            if getattr(error, "possibilities", None) == []:  # nothing is spelt like the option
                from vslam.cli.help import describe_parameters

                error.message += f". {describe_parameters(self, ctx)}"
            raise


class _Group(TyperGroup):
    def format_help(self, ctx: Any, formatter: Any) -> None:
        from vslam.cli.help import show_help

        show_help(self, ctx)


def _plain(message: str) -> str:
    """Rephrase an error message of the parser in plain words. For a misspelt name, a suggestion is
    added."""
    message = plain_reason(message)
    word, found, choices = message.partition(" is not one of ")
    if not found:
        return message
    known = re.findall("'([^']*)'", choices)
    meant = did_you_mean(word.strip("'"), known)
    return f"{word}{found}{choices.rstrip('.')}{meant}."


def application(groups: Collection[typer.Typer]) -> typer.Typer:
    """Create a command-line application from the commands of smaller ones."""
    made = typer.Typer(
        help="Visual SLAM in pure Python.",
        cls=_Group,
        add_completion=False,
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        rich_markup_mode="rich",
    )
    for group in groups:
        made.add_typer(group, cls=_Group)
        for command in group.registered_commands:
            command.cls = _Command
    made.callback(invoke_without_command=True)(version)
    return made


def version(
    show: Annotated[bool, typer.Option("--version", help="Show the version.")] = False,
) -> None:
    if show:
        from importlib.metadata import version as installed

        typer.echo(installed("vslam"))
        raise typer.Exit


@cache
def every_command() -> typer.Typer:
    """Return the application with all commands, those of the laboratory last."""
    own = [group.app for group in _GROUPS]
    return application([*own, *plugins.laboratory(plugins.COMMANDS).values()])


def _treat_as_ctrl_c(signal_number: int, stack: FrameType | None) -> None:
    """The operating system sends SIGTERM when the machine shuts down."""
    handler = signal.getsignal(signal.SIGINT)
    if not callable(handler):  # background jobs of a shell ignore Ctrl-C
        raise KeyboardInterrupt
    handler(signal.SIGINT, stack)


def main() -> None:
    """Run the command line. The exit code is 2 if an input is wrong."""
    # Imports and cached kernels create a million objects that stay alive. To search them for
    # garbage would take a tenth of the start-up time and another 0.16 s at the exit.
    gc.set_threshold(200_000, 20, 100)
    atexit.register(gc.freeze)
    keep_memory()
    set_up_openblas()
    signal.signal(signal.SIGTERM, _treat_as_ctrl_c)
    try:
        for word in sys.argv[1:]:
            require_utf8(Path(word))
        with suppress(FileNotFoundError):  # the folder was removed
            require_utf8(Path.cwd())
        # vslam run does not load the other commands, because preparing their options takes 30 ms.
        (application([run.app]) if sys.argv[1:2] == ["run"] else every_command())()
    except InputError as error:
        typer.echo(f"error: {error}", err=True)
        sys.exit(2)
    except ResultsError as error:
        typer.echo(f"error: {error}", err=True)
        sys.exit(1)
    except Exception as error:
        if sys.flags.dev_mode:
            raise
        typer.echo(
            f"error: {reason(error)}: this is a fault of vslam or of the machine; please report "
            "it with the output that you get with PYTHONDEVMODE=1.",
            err=True,
        )
        sys.exit(1)
