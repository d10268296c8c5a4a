"""Make the tables and figures of the documentation from runs, and check that they are up to date.

    python tools/figures.py [--quick] [--only TEXT]    # make figures, make figures FIGURES=quick
    python tools/figures.py --check                    # make figures-check
    python tools/figures.py --adopt [VERSION]          # stamp files that were made by other means

``figures.toml`` lists every table and figure with the bash command that makes it. The command
writes the files into the folder ``$OUT``. The folder ``$TOWNS`` contains rendered towns. Each
version of the method has its own folder ``$OUT`` in ``runs/figures``. This folder is kept, so that
an interrupted command can be resumed.

The files are then copied to their places in the repository, and their numbers are written into the
tables of the pages. With ``--quick``, the files are copied to ``build/figures`` instead. For each
file, a stamp is written to ``docs/stamps.json`` there. A stamp contains the commit, the version of
the method, the machine, the seed, the command and the digest of the file. A file with a valid stamp
of the current version of the method is not made again.

sources.py explains how a page names the file from which its numbers are taken.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
import time
import tomllib
from dataclasses import asdict, dataclass
from graphlib import TopologicalSorter
from itertools import chain
from pathlib import Path
from typing import NamedTuple

import sources

from vslam import METHOD_VERSION

ROOT = Path(__file__).resolve().parents[1]
STAMPS = "docs/stamps.json"
KINDS = {".csv", ".json", ".svg", ".png", ".jpg"}  # suffixes of files in docs/ that need a stamp


@dataclass(frozen=True)
class Entry:
    """An entry of figures.toml: files that are made by one command.

    Attributes:
        files: paths of the files. If there is a ``history``, they may also be patterns.
        run: bash command that makes the files.
        quick: bash command that makes short variants of the files.
        needs: environment variables that must be set to a path.
        reads: files of other entries that the commands read.
        seed: seed of the random numbers.
        trajectories: whether the files depend on the version of the SLAM method.
        same_in: versions of the method in which the trajectories of these runs are the same. A file
            that one of them made is up to date in the others.
        tested: name of the test that compares the files with the code. Such files need no stamp.
        history: how the files of a finished experiment were made, if there is no command for them.
    """

    files: tuple[str, ...]
    run: str = ""
    quick: str = ""
    needs: tuple[str, ...] = ()
    reads: tuple[str, ...] = ()
    seed: int | None = None
    trajectories: bool = True
    same_in: tuple[int, ...] = ()
    tested: str = ""
    history: str = ""

    def paths(self, root: Path) -> list[str]:
        """Return the paths of the files. Patterns are replaced with the files that match them."""
        found = [sorted(root.glob(one)) if "*" in one else [root / one] for one in self.files]
        return [path.relative_to(root).as_posix() for path in chain(*found)]


@dataclass(frozen=True)
class Stamp:
    """A record of how a file was made. A field is None if it is unknown."""

    digest: str
    commit: str
    date: str
    method: int | None = None
    machine: str | None = None
    seed: int | None = None
    command: str | None = None


class Report(NamedTuple):
    """The result of a check, as sentences.

    ``faults`` must be repaired. ``older`` names files that are missing, or that were made by a
    different version of the SLAM method (``vslam.METHOD_VERSION``). ``typed`` names pages that have
    tables without a source.
    """

    faults: list[str]
    older: list[str]
    typed: list[str]


def read_entries(root: Path = ROOT) -> list[Entry]:
    """Read the entries of figures.toml. An entry comes after the entries whose files it reads."""
    tables = tomllib.loads((root / "tools" / "figures.toml").read_text())["figure"]
    entries = [
        Entry(**{k: tuple(v) if isinstance(v, list) else v for k, v in one.items()})
        for one in tables
    ]
    made_by = {file: k for k, one in enumerate(entries) for file in one.files}
    graph = {k: {made_by[file] for file in one.reads} for k, one in enumerate(entries)}
    return [entries[k] for k in TopologicalSorter(graph).static_order()]


def read_stamps(folder: Path) -> dict[str, Stamp]:
    """Read the stamp of each file; empty if there is no stamps.json."""
    path = folder / STAMPS
    known = json.loads(path.read_text()) if path.exists() else {}
    return {file: Stamp(**one) for file, one in known.items()}


def write_stamps(folder: Path, stamps: dict[str, Stamp]) -> None:
    (folder / STAMPS).parent.mkdir(parents=True, exist_ok=True)
    content = {file: asdict(stamps[file]) for file in sorted(stamps)}
    (folder / STAMPS).write_text(json.dumps(content, indent=1) + "\n")


def digest_of(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()[:16]


def is_older(stamp: Stamp, entry: Entry) -> bool:
    """Return whether a file depends on the method and was made by a version that is out of date."""
    equivalent = entry.same_in if METHOD_VERSION in entry.same_in else (METHOD_VERSION,)
    return entry.trajectories and stamp.method not in equivalent


def make(root: Path, *, quick: bool, only: str = "") -> int:
    """Make the files that are missing or outdated, and return the number of failed entries.

    Args:
        quick: run the short commands and write to build/figures.
        only: make only entries with a file whose path contains this text.
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
            print(f"{name}: kept ({entry.history}).")
        elif not command:
            print(f"{name}: skipped, because it has no quick variant.")
        elif absent and not quick:
            print(f"{name}: skipped; set {' and '.join(absent)} (datasets.md).")
        elif _is_done(entry, target, command):
            print(f"{name}: up to date.")
        else:
            start = time.monotonic()
            succeeded = _run(entry, command, root, target)
            failed += not succeeded
            what = "made in" if succeeded else "FAILED after"
            print(f"{name}: {what} {time.monotonic() - start:.0f} s.", flush=True)
    if not quick:
        fill_pages(root)
    return failed


def fill_pages(root: Path) -> None:
    """Write the numbers of the files into the tables of the pages."""
    for page in pages(root):
        text = page.read_text()
        try:
            filled = sources.fill(text, root)
        except (LookupError, ValueError, OSError):
            continue  # the check names the source that cannot be read
        if filled != text:
            page.write_text(filled)
            print(f"{page.relative_to(root)}: numbers updated.", flush=True)


def _is_done(entry: Entry, target: Path, command: str) -> bool:
    stamps = read_stamps(target)
    own = [stamps.get(file) for file in entry.files]
    inputs = [stamps[file].date for file in entry.reads if file in stamps]
    return all(
        stamp is not None
        and (target / file).exists()
        and stamp.digest == digest_of(target / file)
        and stamp.command == command
        and not is_older(stamp, entry)
        and stamp.date >= max(inputs, default="")
        for file, stamp in zip(entry.files, own, strict=True)
    )


def _run(entry: Entry, command: str, root: Path, target: Path) -> bool:
    """Run the command of an entry, and copy and stamp its files. Returns whether it succeeded."""
    from vslam_lab.towns.site import Variation
    from vslam_lab.towns.store import cache_folder, folder_name

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
    stamps = read_stamps(target)
    for file in entry.files:
        (target / file).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(out / Path(file).name, target / file)
        stamps[file] = _stamp(target / file, entry, command, root, METHOD_VERSION)
    write_stamps(target, stamps)
    return True


def _stamp(path: Path, entry: Entry, command: str, root: Path, method: int) -> Stamp:
    from vslam.report.summary import this_machine

    machine = this_machine()
    return Stamp(
        digest_of(path),
        _commit(root),
        time.strftime("%Y-%m-%d %H:%M:%S"),
        method,
        f"{machine.cpu}, {machine.cores} cores, {machine.platform}",
        entry.seed,
        command,
    )


def _commit(root: Path) -> str:
    """Return the commit that is checked out. If files outside of docs/ were changed, say so."""
    head = _git(root, "rev-parse", "--short", "HEAD")
    changed = _git(root, "status", "--porcelain", "--untracked-files=no", "--", ".", ":!docs")
    return f"{head} with changes" if changed else head


def _git(root: Path, *words: str) -> str:
    done = subprocess.run(["git", *words], cwd=root, check=True, capture_output=True, text=True)
    return done.stdout.strip()


def adopt(root: Path, method: int | None = None) -> list[str]:
    """Stamp every file that has no valid stamp, and return these files.

    Args:
        method: version of the method that made the files on this machine. If it is None, a stamp
            contains only the commit that wrote the file.
    """
    stamps, adopted = read_stamps(root), []
    entries = {file: entry for entry in read_entries(root) for file in entry.paths(root)}
    for file in entries:
        if entries[file].tested or not (root / file).exists():
            continue
        if file in stamps and stamps[file].digest == digest_of(root / file):
            continue
        # Commits that only moved the file are skipped.
        words = ("log", "-1", "--follow", "--diff-filter=AM", "--format=%h %as", "--", file)
        commit, _, date = _git(root, *words).partition(" ")
        stamps[file] = (
            Stamp(digest_of(root / file), commit, date)
            if method is None
            else _stamp(root / file, entries[file], entries[file].run, root, method)
        )
        adopted.append(file)
    write_stamps(root, stamps)
    return adopted


def check(root: Path) -> Report:
    """Check that all files have valid stamps, and that tables on pages agree with their files."""
    entries = {file: entry for entry in read_entries(root) for file in entry.paths(root)}
    stamps, report = read_stamps(root), Report([], [], [])
    below = (path for path in (root / "docs").rglob("*") if path.suffix in KINDS)
    there = {path.relative_to(root).as_posix() for path in below} - {STAMPS}
    texts = {page: page.read_text() for page in pages(root)}
    for file in sorted(there | entries.keys()):
        if file not in entries:
            report.faults.append(f"{file}: name the command that makes it in tools/figures.toml")
        elif not (root / file).exists():
            report.older.append(f"{file}: not made yet")
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
            on = f", shown on {', '.join(map(str, names))}" if names else ""
            report.older.append(f"{file}: {origin(stamps[file])}{on}")
    for page, text in texts.items():
        name = page.relative_to(root)
        report.faults.extend(f"{name}: {one}" for one in sources.compare(text, root))
        typed, tables = sources.untraced(text)
        if typed and str(name) not in entries:
            report.typed.append(f"{name}: {typed} of {tables} tables")
    return report


def pages(root: Path) -> list[Path]:
    """Find README and the pages of the documentation, except pages that are generated from code."""
    below = sorted((root / "docs").rglob("*.md"))
    made = root / "docs" / "reference"
    return [root / "README.md", *(page for page in below if made not in page.parents)]


def used(page: Path, text: str, root: Path) -> set[str]:
    """Find the files that a page shows, links to, or names as the source of a table."""
    links = re.findall(r"\]\(([^)#\s:]+)\)", text)
    named = {os.path.relpath(os.path.normpath(page.parent / link), root) for link in links}
    return named.union(*map(sources.files_of, sources.COMMENT.findall(text)))


def origin(stamp: Stamp) -> str:
    """Describe the origin of a file, for example ``version 1, commit 0123abc, 2026-11-25``."""
    version = "before version 1" if stamp.method is None else f"version {stamp.method}"
    return f"{version}, commit {stamp.commit}, {stamp.date[:10]}"


def mark_older(page: Path, text: str, root: Path) -> str:
    """Mark the files on a page that were made by a different version of the method.

    There is a line before each table from such a file, and a list of these files at the end.
    """
    stamps = read_stamps(root)
    older = {
        file: origin(stamps[file])
        for entry in read_entries(root)
        for file in entry.paths(root)
        if file in stamps and is_older(stamps[file], entry)
    }

    def marked(found: re.Match[str]) -> str:
        names = sorted(sources.files_of(found[1]) & older.keys())
        origins = "; ".join(f"`{file}`: {older[file]}" for file in names)
        return (
            f"*Older than version {METHOD_VERSION} of the method: {origins}.*\n\n" if names else ""
        )

    names = sorted(used(page, text, root) & older.keys())
    text = sources.COMMENT.sub(marked, text)
    if names:
        items = "".join(f"- `{file}`: {older[file]}\n" for file in names)
        title = f"Files that are older than version {METHOD_VERSION} of the method:"
        text += f"\n```{{note}}\n{title}\n\n{items}```\n"
    return text


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="short variants, in build/figures")
    parser.add_argument("--only", default="", help="only files whose path contains this text")
    parser.add_argument("--check", action="store_true", help="only check the files and pages")
    parser.add_argument(
        "--adopt", type=int, nargs="?", const=0, metavar="VERSION",
        help="stamp files that were made by other means; VERSION of the method, if known",
    )  # fmt: skip
    options = parser.parse_args()
    if options.adopt is not None:
        print("\n".join(adopt(ROOT, options.adopt or None)))
    elif options.check:
        report = check(ROOT)
        print(
            f"Made by another version of the method than {METHOD_VERSION}:",
            *report.older,
            sep="\n  ",
        )
        print("Tables that name no source:", *report.typed, sep="\n  ")
        print("Faults:", *(report.faults or ["none"]), sep="\n  ")
        sys.exit(bool(report.faults))
    else:
        sys.exit(make(ROOT, quick=options.quick, only=options.only) > 0)


if __name__ == "__main__":
    main()
