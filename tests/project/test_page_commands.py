"""The real command line accepts every command of the pages, and three of them run to the end.

The packages of ``docs/howto/plugins.md`` are installed and run in ``test_plugins.py``.
"""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from itertools import takewhile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from source_files import write_calibration, write_video
from typer.main import get_command

from vslam.cli.main import every_command
from vslam.cli.options import read_thresholds
from vslam.datasets.perturbation.laws import parse_perturbation
from vslam.support.errors import InputError

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
PAGES = [path for path in sorted(DOCS.rglob("*.md")) if path.name != "commands.md"]
PAGES += [
    *sorted(ROOT.glob("*.md")),
    ROOT / "loopclosure" / "vocabulary.md",
    ROOT / "backend" / "inertial.md",
]
FENCE = re.compile(r"^```(\S*)\n(.*?)^```$", re.DOTALL | re.MULTILINE)
SPAN = re.compile(r"`(vslam [^`\n]+)`")
OF_PLUGINS = "thumbnail", "frames", "haze"  # the names in docs/howto/plugins.md
USAGE_ERROR: Any = typer.BadParameter.__base__  # typer does not export it
UNFINISHED = "MissingParameter", "NoArgsIsHelpError", "BadOptionUsage", "Exit"
N = 8  # frames of a run


def commands_of(text: str) -> Iterator[list[str]]:
    """Yield the words of each command in the shell blocks of a page, without redirections."""
    for language, block in FENCE.findall(text):
        for line in block.replace("\\\n", " ").splitlines() if language in ("", "sh") else ():
            if language or line.startswith("vslam "):
                yield from commands_in(line)


def commands_in(line: str) -> Iterator[list[str]]:
    """Split a line of shell at its operators and loops."""
    words: list[str] = []
    lexer = shlex.shlex(re.sub(r"\$\(.*?\)", "$SHELL", line), posix=True, punctuation_chars=True)
    lexer.whitespace_split = True
    for word in [*lexer, ";"]:
        if word == "do" or not word.strip(";&|()<>"):
            if words:
                yield words
            words = []
        else:
            words.append(word)


def parameters_of(words: list[str]) -> dict[str, Any]:
    """Return the parameters that the command line reads from a command, which is not run."""
    context = get_command(every_command()).make_context(words[0], words[1:])
    while hasattr(context.command, "commands"):
        rest = [*context._protected_args, *context.args]
        name, command, rest = context.command.resolve_command(context, rest)
        context = command.make_context(name, rest, parent=context)
    return context.params


def check(words: list[str]) -> None:
    parameters = parameters_of(words)
    thresholds = str(parameters.get("thresholds") or parameters.get("config") or "")
    if thresholds and not thresholds.endswith((".json", "FILE")):
        read_thresholds(thresholds)
    perturb = None if "loops" in words else parameters.get("perturb")
    for spec in (perturb or "none").split(","):
        for law in spec.split("+"):
            if law not in ("none", "all"):
                parse_perturbation(law, seed=0)


@pytest.mark.parametrize("path", PAGES, ids=lambda path: str(path.relative_to(ROOT)))
def test_the_command_line_accepts_every_command(path: Path):
    targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    for words in commands_of(path.read_text()):
        if words[0] == "vslam" and not set(OF_PLUGINS) & set(re.split("[ :]", " ".join(words))):
            check(words)
        elif words[0] == "make":
            assert {word for word in words[1:] if word.isalpha()} <= {*targets}
        elif words[0].startswith("python") and words[1].startswith("tools/"):
            own = takewhile(lambda word: word != "--", words)
            options = {word.partition("=")[0] for word in own if word.startswith("--")}
            source = (ROOT / words[1]).read_text()
            assert all(f'"{option}"' in source for option in options), words


@pytest.mark.parametrize("path", PAGES, ids=lambda path: str(path.relative_to(ROOT)))
def test_the_command_line_accepts_every_command_in_a_sentence(path: Path):
    for span in SPAN.findall(FENCE.sub("", path.read_text())):
        try:
            check(re.sub(r"\bN\b", "1", span).split())
        except (USAGE_ERROR, typer.Exit) as error:  # a sentence may leave out arguments
            if type(error).__name__ not in UNFINISHED:
                raise


@pytest.mark.parametrize(
    "line",
    [
        "vslam run --sequence 00",
        "vslam runs",
        "vslam run --max-frames many",
        "vslam run --config orb.features=5",
        "vslam run --perturb mist:3",
    ],
)
def test_a_wrong_command_is_seen(line: str):
    (words,) = commands_of(f"```sh\n{line}\n```")
    with pytest.raises((USAGE_ERROR, InputError)):
        check(words)


def test_the_reader_of_commands_splits_lines_as_a_shell_does():
    text = (
        "```sh\nfor n in 1 2; do vslam run \\\n --seq $n; done  # vslam no\n"
        "(cd a && vslam info > b)\n```\n```\nvslam map info c\noutput\n```\n"
    )
    found = [words for words in commands_of(text) if words[0] == "vslam"]
    assert found == [
        ["vslam", "run", "--seq", "$n"], ["vslam", "info"], ["vslam", "map", "info", "c"]
    ]  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(
    ("page", "command"),
    [
        ("README.md", "vslam run --seq 00 --perturb brightness"),
        ("README.md", "vslam run --data drive.mp4 --side-by-side --calib stereo.yaml"),
        (
            "docs/tutorial/first_run.md",
            "vslam run --dataset synthetic --seq demo --max-frames 60",
        ),
    ],
)
def test_a_command_runs_and_writes_the_files_that_the_tutorial_lists(
    page: str,
    command: str,
    corridor,
    kitti_tree: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
):
    assert command in (ROOT / page).read_text()
    pairs = [np.hstack(pair) for pair in zip(corridor.left, corridor.right, strict=True)]
    write_video(tmp_path / "drive.mp4", pairs[:N])
    write_calibration(tmp_path / "stereo.yaml", corridor.camera)
    monkeypatch.setenv("KITTI_ROOT", str(kitti_tree))
    monkeypatch.chdir(tmp_path)
    program = Path(sys.executable).with_name("vslam")
    shorter = command.removesuffix(" --max-frames 60").split()[1:]

    done = subprocess.run(
        [program, *shorter, "--max-frames", str(N)], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout + done.stderr
    run = tmp_path / "runs" / "latest"
    assert len((run / "trajectory_kitti.txt").read_text().splitlines()) == N
    listed = (DOCS / "tutorial" / "report.md").read_text().partition("## Files of a run")[2]
    for path in run.iterdir():
        assert f"`{path.name}" in listed or path.name.startswith("."), path.name
