"""Make the tables and figures of README and the documentation from runs, and check them.

    python tools/figures.py [--quick] [--only TEXT]    # make figures, make figures FIGURES=quick
    python tools/figures.py --check                    # make figures-check
    python tools/figures.py --adopt                    # stamp files that were made by other means

``figures.toml`` lists every table and figure with the commands that make it. A command is run by
bash in the root of the repository and writes into the folder ``$OUT`` under the names of the files;
``$TOWNS`` is the folder of rendered towns. ``$OUT`` is kept in ``runs/figures``, one folder for
each version of the method, so that an interrupted command continues. The files are copied to their
places, or below ``build/figures`` with ``--quick``, and ``docs/stamps.json`` there gets a stamp for
each: commit, version of the method, machine, seed, command and digest. What has a valid stamp of
this version is not made again.

Tables in Markdown that are written by hand name their source in a comment before them. A line of it
describes one row of the table, and the last line all further rows::

    <!-- from: docs/x.csv | drive=$1, light=clean | | ate_m (system=ours) | found; missed -->

It holds the CSV file, the filter that selects its row (``$1``: the text of the first cell of the
table's row, or what its backticks enclose), then the columns that the numbers of each cell must
equal, as they are rounded there. An empty place is not compared; ``mean x`` is the mean over all
selected rows; a line ``-`` skips a row. Before a paragraph, the comment names columns whose values
the paragraph must mention.
"""

from __future__ import annotations

import argparse
import csv
import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
import time
import tomllib
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from graphlib import TopologicalSorter
from itertools import chain, zip_longest
from pathlib import Path
from typing import NamedTuple

from vslam import METHOD_VERSION

ROOT = Path(__file__).resolve().parents[1]
STAMPS = "docs/stamps.json"
KINDS = {".csv", ".json", ".svg", ".png", ".jpg"}  # of files below docs/ that need a stamp
COMMENT = re.compile(r"<!-- from:(.*?)-->[ ]*\n", re.DOTALL)
TABLE = re.compile(r"(--> *\n)?(?:^ *\|.*\n)+?^ *\|[-| :]+\|\n((?:^ *\|.*\n?)+)", re.MULTILINE)
DECIMAL = re.compile(r"\d\.\d")
NUMBER = re.compile(r"(?<![\w.])[-+]?\d[\d,]*(?:\.\d+)?")


@dataclass(frozen=True)
class Entry:
    """Files that are made together.

    ``run`` and ``quick`` are commands for bash, ``needs`` environment variables that must name a
    path, ``reads`` files of other entries. ``trajectories`` is False if no version of the method
    changes the files. ``tested`` names the test that compares the files with the code, so that they
    need no stamp. ``history`` says what made the files of a finished experiment; no command makes
    them again, and patterns may name them.
    """

    files: tuple[str, ...]
    run: str = ""
    quick: str = ""
    needs: tuple[str, ...] = ()
    reads: tuple[str, ...] = ()
    seed: int | None = None
    trajectories: bool = True
    tested: str = ""
    history: str = ""

    def paths(self, root: Path) -> list[str]:
        """The files, with patterns resolved."""
        found = [sorted(root.glob(one)) if "*" in one else [root / one] for one in self.files]
        return [path.relative_to(root).as_posix() for path in chain(*found)]


@dataclass(frozen=True)
class Stamp:
    """How a file was made. What git's history does not tell of an older file is None."""

    digest: str
    commit: str
    date: str
    method: int | None = None
    machine: str | None = None
    seed: int | None = None
    command: str | None = None


class Report(NamedTuple):
    """What a check found: ``faults`` must be repaired, ``older`` and ``typed`` are listed."""

    faults: list[str]
    older: list[str]
    typed: list[str]


def read_entries(root: Path = ROOT) -> list[Entry]:
    """The entries of figures.toml, inputs before what is made of them."""
    tables = tomllib.loads((root / "tools" / "figures.toml").read_text())["figure"]
    entries = [
        Entry(**{k: tuple(v) if isinstance(v, list) else v for k, v in one.items()})
        for one in tables
    ]
    made_by = {file: k for k, one in enumerate(entries) for file in one.files}
    graph = {k: {made_by[file] for file in one.reads} for k, one in enumerate(entries)}
    return [entries[k] for k in TopologicalSorter(graph).static_order()]


def read_stamps(folder: Path) -> dict[str, Stamp]:
    """Stamps by the path of the file; empty without stamps.json."""
    path = folder / STAMPS
    known = json.loads(path.read_text()) if path.exists() else {}
    return {file: Stamp(**one) for file, one in known.items()}


def write_stamps(folder: Path, stamps: dict[str, Stamp]) -> None:
    """Write stamps.json, sorted by file."""
    (folder / STAMPS).parent.mkdir(parents=True, exist_ok=True)
    content = {file: asdict(stamps[file]) for file in sorted(stamps)}
    (folder / STAMPS).write_text(json.dumps(content, indent=1) + "\n")


def digest_of(path: Path) -> str:
    """The first 16 hexadecimal digits of SHA-256."""
    return hashlib.sha256(path.read_bytes()).hexdigest()[:16]


def is_older(stamp: Stamp, entry: Entry) -> bool:
    """Whether another version of the method made a file that depends on it."""
    return entry.trajectories and stamp.method != METHOD_VERSION


def make(root: Path, *, quick: bool, only: str = "") -> int:
    """Make what is missing or older, and print a sentence for each entry.

    Args:
        root: repository.
        quick: run the short commands, and write below build/figures.
        only: leave out entries that have no file with this text in its path.

    Returns:
        Number of entries that failed.
    """
    target = root / "build" / "figures" if quick else root
    failed = 0
    for entry in read_entries(root):
        if not any(only in file for file in entry.files):
            continue
        command = entry.quick if quick else entry.run
        more = f" and {len(entry.files) - 1} more" if len(entry.files) > 1 else ""
        name = f"{entry.files[0]}{more}"
        absent = [x for x in entry.needs if not os.path.exists(os.environ.get(x, ""))]
        if entry.history:
            print(f"{name}: kept, {entry.history}.")
        elif not command:
            print(f"{name}: skipped, it has no quick variant.")
        elif absent and not quick:
            print(f"{name}: skipped, {' and '.join(absent)} must name files (datasets.md).")
        elif _is_done(entry, target, command):
            print(f"{name}: up to date.")
        else:
            start = time.monotonic()
            made = _made(entry, command, root, target)
            failed += not made
            what = "made in" if made else "FAILED after"
            print(f"{name}: {what} {time.monotonic() - start:.0f} s.", flush=True)
    return failed


def _is_done(entry: Entry, target: Path, command: str) -> bool:
    stamps = read_stamps(target)
    mine = [stamps.get(file) for file in entry.files]
    inputs = [stamps[file].date for file in entry.reads if file in stamps]
    return all(
        stamp is not None
        and (target / file).exists()
        and stamp.digest == digest_of(target / file)
        and stamp.command == command
        and not is_older(stamp, entry)
        and stamp.date >= max(inputs, default="")
        for file, stamp in zip(entry.files, mine, strict=True)
    )


def _made(entry: Entry, command: str, root: Path, target: Path) -> bool:
    from vslam.datasets.synthetic.site import Variation
    from vslam.datasets.synthetic.store import cache_folder, folder_name
    from vslam.report.summary import this_machine

    kind = "full" if target == root else "quick"
    out = root / "runs" / "figures" / f"{kind}-{METHOD_VERSION}" / entry.files[0].replace("/", "-")
    out.mkdir(parents=True, exist_ok=True)
    environment = os.environ | {
        "OUT": str(out),
        "TOWNS": str(cache_folder() / folder_name(Variation())),
        "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
    }
    print(command.strip(), flush=True)
    shell = ["bash", "-euo", "pipefail", "-c", command]
    if subprocess.run(shell, cwd=root, env=environment, check=False).returncode:
        return False
    machine = this_machine()
    stamps = read_stamps(target)
    for file in entry.files:
        (target / file).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(out / Path(file).name, target / file)
        stamps[file] = Stamp(
            digest_of(target / file),
            _commit(root),
            time.strftime("%Y-%m-%d %H:%M:%S"),
            METHOD_VERSION,
            f"{machine.cpu}, {machine.cores} cores, {machine.platform}",
            entry.seed,
            command,
        )
    write_stamps(target, stamps)
    return True


def _commit(root: Path) -> str:
    """The commit that is checked out, with a mark if code was changed since."""
    head = _git(root, "rev-parse", "--short", "HEAD")
    changed = _git(root, "status", "--porcelain", "--untracked-files=no", "--", ".", ":!docs")
    return f"{head} with changes" if changed else head


def _git(root: Path, *words: str) -> str:
    done = subprocess.run(["git", *words], cwd=root, check=True, capture_output=True, text=True)
    return done.stdout.strip()


def adopt(root: Path) -> list[str]:
    """Stamp every file that has no valid stamp with the commit that wrote it, and return them."""
    stamps, adopted = read_stamps(root), []
    entries = {file: entry for entry in read_entries(root) for file in entry.paths(root)}
    for file in entries:
        known = stamps[file].digest if file in stamps else ""
        if entries[file].tested or known == digest_of(root / file):
            continue
        # A commit that only moved the file did not write it.
        words = ("log", "-1", "--follow", "--diff-filter=AM", "--format=%h %as", "--", file)
        commit, _, date = _git(root, *words).partition(" ")
        stamps[file] = Stamp(digest_of(root / file), commit, date)
        adopted.append(file)
    write_stamps(root, stamps)
    return adopted


def check(root: Path) -> Report:
    """Check that all tables and figures have valid stamps and tables in Markdown their values."""
    entries = {file: entry for entry in read_entries(root) for file in entry.paths(root)}
    stamps, report = read_stamps(root), Report([], [], [])
    below = (path for path in (root / "docs").rglob("*") if path.suffix in KINDS)
    there = {path.relative_to(root).as_posix() for path in below} - {STAMPS}
    texts = {page: page.read_text() for page in pages(root)}
    for file in sorted(there | entries.keys()):
        if file not in entries:
            report.faults.append(f"{file}: name the command that makes it in tools/figures.toml")
        elif not (root / file).exists():
            report.faults.append(f"{file}: missing; make figures makes it")
        elif entries[file].tested:
            continue
        elif file not in stamps:
            report.faults.append(f"{file}: has no stamp; make it with make figures")
        elif stamps[file].digest != digest_of(root / file):
            report.faults.append(f"{file}: was changed after the run of its stamp")
        elif is_older(stamps[file], entries[file]):
            names = [
                p.relative_to(root) for p, text in texts.items() if file in used(p, text, root)
            ]
            on = f", on {', '.join(map(str, names))}" if names else ""
            report.older.append(f"{file}: {origin(stamps[file])}{on}")
    for page, text in texts.items():
        name = page.relative_to(root)
        report.faults.extend(f"{name}: {one}" for one in compare(text, root))
        tables = [] if str(name) in entries else TABLE.findall(text)
        typed = sum(not comment and bool(DECIMAL.search(body)) for comment, body in tables)
        if typed:
            report.typed.append(f"{name}: {typed} of {len(tables)} tables")
    return report


def pages(root: Path) -> list[Path]:
    """README and the pages of the documentation that report figures."""
    return [root / "README.md", *sorted((root / "docs").glob("*/*.md"))]


def used(page: Path, text: str, root: Path) -> set[str]:
    """The files that a page links, shows or names as a source."""
    links = re.findall(r"\]\(([^)#\s:]+)\)", text)
    named = {os.path.relpath(os.path.normpath(page.parent / link), root) for link in links}
    sources = (line.partition("|")[0].strip() for comment, _ in traced(text) for line in comment)
    return named | set(sources)


def origin(stamp: Stamp) -> str:
    """``method version 1, commit 0123abc, 2026-11-25``."""
    version = f"before {METHOD_VERSION}" if stamp.method is None else f"{stamp.method}"
    return f"method version {version}, commit {stamp.commit}, {stamp.date[:10]}"


def mark_older(page: Path, text: str, root: Path) -> str:
    """The text of a page, in which a line before each traced table and a note at the end name the
    files that another version of the method made."""
    stamps = read_stamps(root)
    older = {
        file: origin(stamps[file])
        for entry in read_entries(root)
        for file in entry.paths(root)
        if file in stamps and is_older(stamps[file], entry)
    }

    def marked(found: re.Match[str]) -> str:
        sources = dict.fromkeys(line.partition("|")[0].strip() for line in _lines(found[1]))
        named = "; ".join(f"`{file}`: {older[file]}" for file in sources if file in older)
        return f"*Older than the current method (version {METHOD_VERSION}): {named}.*\n\n" * bool(
            named
        )

    rest = sorted(used(page, text, root) & older.keys())
    text = COMMENT.sub(marked, text)
    if rest:
        items = "\n".join(f"- `{file}`: {older[file]}" for file in rest)
        text += (
            f"\n```{{note}}\nAn older method than version {METHOD_VERSION} made:\n\n{items}\n```\n"
        )
    return text


def _lines(comment: str) -> list[str]:
    return [line.strip() for line in comment.strip().splitlines()]


def traced(text: str) -> Iterator[tuple[list[str], str]]:
    """The lines of each source comment, and the table or paragraph that follows it."""
    for found in COMMENT.finditer(text):
        yield _lines(found[1]), text[found.end() :].partition("\n\n")[0]


def compare(text: str, root: Path) -> Iterator[str]:
    """A sentence for each value on a page that differs from its source."""
    for lines, after in traced(text):
        try:
            if not after.lstrip().startswith("|"):
                for line in lines:
                    yield from _paragraph_faults(line, after, root)
                continue
            rows = [_cells(row) for row in after.splitlines()][2:]
            if len(lines) > len(rows):
                yield f"{len(lines)} source lines for the {len(rows)} rows after {rows[0]}"
            for line, row in zip_longest(lines[: len(rows)], rows, fillvalue=lines[-1]):
                yield from _row_faults(line, row, root)
        except (LookupError, ValueError, OSError) as error:
            yield f"source {lines[0]!r} cannot be read: {error}"


def _cells(row: str) -> list[str]:
    return [cell.strip() for cell in row.strip().strip("|").split("|")]


def _row_faults(line: str, row: list[str], root: Path) -> Iterator[str]:
    if line == "-":
        return
    file, filters, *columns = [part.strip() for part in line.split("|")]
    for cell, column in zip(row, columns, strict=False):
        values = _values(root / file, filters, column, row) if column else []
        left, numbers = cell, []
        for value in values:
            if isinstance(value, str):
                if value not in left:
                    yield f"{row[0]}: {cell!r} lacks {value!r} of {file} ({column})"
                left = left.replace(value, "", 1)
            else:
                numbers.append(value)
        shown = NUMBER.findall(left)
        agree = len(shown) == len(numbers) and all(map(_is_rounded, shown, numbers))
        if column and not agree:
            yield f"{row[0]}: {cell!r} differs from {values} of {file} ({column})"


def _paragraph_faults(line: str, paragraph: str, root: Path) -> Iterator[str]:
    file, filters, column = [part.strip() for part in line.split("|")]
    shown = NUMBER.findall(paragraph)
    for value in _values(root / file, filters, column, []):
        if isinstance(value, str):
            found = value in paragraph
        else:
            found = any(_is_rounded(number, value) for number in shown)
        if not found:
            yield f"{paragraph[:40]!r}... does not mention {value} of {file} ({column})"


def _is_rounded(shown: str, value: float) -> bool:
    number = shown.replace(",", "")
    decimals = len(number.partition(".")[2])
    return abs(float(number) - value) <= 0.5 * 10.0**-decimals * (1 + 1e-6)


def _values(path: Path, filters: str, column: str, row: list[str]) -> list[float | str]:
    """The values that a cell must show: numbers, or texts where the CSV file has texts."""
    with path.open(newline="", encoding="utf-8") as file:
        table = list(csv.DictReader(file))
    found: list[float | str] = []
    own = ""
    for field in reversed(column.split(";")):
        name, _, more = field.strip().removesuffix(")").partition(" (")
        own = more or own
        wanted = _wanted(f"{filters}, {own}", row)
        rows = [one for one in table if wanted.items() <= one.items()]
        if name.startswith("mean "):
            numbers = [float(one[name.removeprefix("mean ")]) for one in rows]
            found.append(sum(numbers) / len(numbers))
        elif len(rows) != 1:
            raise LookupError(f"{len(rows)} rows of {path.name} have {wanted}")
        elif value := rows[0][name]:
            found.append(float(value) if NUMBER.fullmatch(value) else value)
    return found[::-1]


def _wanted(filters: str, row: list[str]) -> dict[str, str]:
    """Values by column, in which ``$1`` is replaced by the text of the row's first cell."""

    def text(found: re.Match[str]) -> str:
        cell = row[int(found[1]) - 1]
        code = re.search("`(.*?)`", cell)
        return code[1] if code else cell.strip("*")

    pairs = [one.split("=", 1) for one in re.split(r", (?=\w+=)", filters.strip(", "))]
    return {key: re.sub(r"\$(\d)", text, value) for key, value in pairs}


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="minutes; writes to build/figures")
    parser.add_argument("--only", default="", help="files whose path contains this text")
    parser.add_argument("--check", action="store_true", help="make nothing; check what is there")
    parser.add_argument("--adopt", action="store_true", help="stamp by the history of git")
    options = parser.parse_args()
    if options.adopt:
        print("\n".join(adopt(ROOT)))
    elif options.check:
        report = check(ROOT)
        print("Made by another version of the method:", *report.older, sep="\n  ")
        print("Tables that are written by hand without a source:", *report.typed, sep="\n  ")
        print("Faults:", *(report.faults or ["none"]), sep="\n  ")
        sys.exit(bool(report.faults))
    else:
        sys.exit(make(ROOT, quick=options.quick, only=options.only) > 0)


if __name__ == "__main__":
    main()
