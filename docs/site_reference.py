"""Generates the reference pages of the commands and of the modules from the code."""

from __future__ import annotations

import ast
import re
import shutil
from importlib.util import find_spec
from pathlib import Path
from typing import get_args

MODULES = (
    "vslam.slam",
    "vslam.types.camera",
    "vslam.config",
    "vslam.types.features",
    "vslam.types.trajectory",
    "vslam.types.map",
    "vslam.method.gaps",
    "vslam.types.loops",
    "vslam.support.errors",
    "vslam.types.geometry",
    "vslam.support.plugins",
    "vslam.datasets",
    "vslam.datasets.frames",
    "vslam.datasets.sources",
    "vslam.datasets.perturbation",
    "vslam.calibration.files",
    "vslam.calibration.models",
    "vslam.loopclosure.detector",
    "vslam.loopclosure.registry",
    "vslam.run.slam_run",
    "vslam.run.pipeline",
    "vslam.run.outcome",
    "vslam.evaluation.trajectories",
    "vslam.maps.storage",
    "vslam.report.schema",
)


def write_reference(folder: Path) -> None:
    (folder / "commands.md").write_text(commands_page())
    generated = folder / "generated"
    shutil.rmtree(generated, ignore_errors=True)
    generated.mkdir(parents=True)
    for name in MODULES:
        title = name.replace("_", r"\_")
        page = f"{title}\n{'=' * len(title)}\n\n.. automodule:: {name}\n"
        (generated / f"{name}.rst").write_text(page)


def module_rows() -> list[str]:
    """Return the rows of the table in docs/reference/modules.md.

    Each row has a module and the first paragraph of its docstring.
    """
    rows = []
    for name in MODULES:
        origin = find_spec(name).origin
        about = ast.get_docstring(ast.parse(Path(origin).read_text())).partition("\n\n")[0]
        file = Path(origin).relative_to(Path(__file__).parents[1])
        text = " ".join(about.replace("``", "`").split())
        rows.append(f"| [`{name}`](../../{file.as_posix()}) | {text} |")
    return rows


def commands_page() -> str:
    """Return the page with the arguments and options of every command."""
    import typer

    from vslam.cli.main import every_command

    lines = ["# Commands", "", "This page is generated from the code of the command line."]
    lines += ["`vslam COMMAND --help` prints the same descriptions.", ""]
    for name, command in _commands("vslam", typer.main.get_command(every_command())):
        lines += [f"## `{name}`", "", _plain(command.help or ""), ""]
        options = [_row(p) for p in command.params if p.name != "help"]
        if options:
            lines += ["| option | what it does | default |", "|---|---|---|", *options, ""]
        examples = re.findall(r"^ *(vslam .*?)$", _plain(command.epilog or ""), re.MULTILINE)
        if examples:
            lines += ["```sh", *examples, "```", ""]
    return "\n".join(lines)


def _commands(name, command):
    inner = getattr(command, "commands", None)
    if not inner:
        return [(name, command)]
    return [found for key, one in inner.items() for found in _commands(f"{name} {key}", one)]


def _row(parameter) -> str:
    names = [*parameter.opts, *parameter.secondary_opts]
    if parameter.param_type_name == "argument":
        names = [(parameter.metavar or parameter.name or "").strip("{}[]").upper()]
    shown = getattr(parameter, "show_default", None)
    default = shown if isinstance(shown, str) else parameter.default
    if default in (None, "", False) or callable(default) or str(default) == "Sentinel.UNSET":
        default = ""
    text = _plain(getattr(parameter, "help", None) or "").replace("\n", " ")
    descriptor = getattr(parameter, "type_descriptor", None)
    choices = [
        one for one in get_args(getattr(descriptor, "annotation", None)) if isinstance(one, str)
    ]
    if not all(choice in text for choice in choices):
        text += " One of " + ", ".join(f"`{choice}`" for choice in choices) + "."
    cells = (", ".join(f"`{name}`" for name in names), _marked_up(text), f"{default}")
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def _marked_up(text: str) -> str:
    """Format options in a sentence as code, and names of pages as links."""
    text = re.sub(r"docs/(\w+/(\w+)\.md)", r"[\2](../\1)", text)
    parts = text.split("`")  # every second part is already code
    parts[::2] = [re.sub(r"(?<![\w-])(--[a-z][a-z-]*)", r"`\1`", part) for part in parts[::2]]
    return "`".join(parts)


def _plain(text: str) -> str:
    """Remove the markup of Rich."""
    text = re.sub(r"\[b\](.*?)\[/b\]", r"`\1`", text)
    return text.replace("\\[", "[").strip()
