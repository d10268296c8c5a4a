"""Print the size of the repository at some commits, as Markdown tables.

    python tools/size.py [COMMIT ...]     # HEAD without a commit; uncommitted changes do not count

The first table has a row for each package: lines of code, of comments, of docstrings, and blank
lines. The second has the totals, the words of README and docs, the thresholds (fields of
``vslam/config.py``), the options of the command line and the size of the wheel, which is built and
whose command line is asked.
"""

from __future__ import annotations

import ast
import io
import os
import subprocess
import sys
import tempfile
import tokenize
from collections import Counter, defaultdict
from collections.abc import Iterable
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
KINDS = ("code", "comments", "docstrings", "blank")
PRODUCT = ("vslam", "frontend", "backend", "loopclosure")
OPTIONS = """
import sys, typer

def options(command):
    of_groups = getattr(command, "commands", {}).values()
    own = sum(one.param_type_name == "option" for one in command.params)
    return own + sum(map(options, of_groups))

def count(app):
    command = typer.main.get_command(app)
    print(options(command.commands["run"]), options(command))

typer.Typer.__call__ = count
sys.argv = ["vslam"]
from vslam.cli.main import main
main()
"""


def lines_of(text: str) -> Counter[str]:
    """Count the lines of a Python file by their kind. A line with code counts as code only."""
    kinds = dict.fromkeys(range(1, text.count("\n") + 1), "blank")
    layout = (tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER)
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type not in layout:
            kind = "comments" if token.type == tokenize.COMMENT else "code"
            for row in range(token.start[0], token.end[0] + 1):
                kinds[row] = "code" if "code" in (kind, kinds.get(row)) else kind
    documented = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    for node in ast.walk(ast.parse(text)):
        for below in node.body if isinstance(node, documented) else ():
            # Texts below attributes and constants document them, too.
            if isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant):
                kinds |= dict.fromkeys(range(below.lineno, below.end_lineno + 1), "docstrings")
    return Counter(kinds.values())


def package_of(path: Path) -> str:
    """Return the folder of a Python file: two levels deep within ``vslam`` and ``tools``."""
    return "/".join(path.parts[:-1][: 2 if path.parts[0] in ("vslam", "tools") else 1]) or "."


def thresholds(config: str) -> int:
    """Count the fields of the sections of a configuration."""
    classes = [one for one in ast.parse(config).body if isinstance(one, ast.ClassDef)]
    return sum(isinstance(x, ast.AnnAssign) for c in classes if c.name != "Config" for x in c.body)


def measure(root: Path) -> tuple[dict[str, Counter[str]], dict[str, str]]:
    """Measure the files of a commit.

    Returns:
        The lines of each package by their kind, and the other measures by their name.
    """
    packages: dict[str, Counter[str]] = defaultdict(Counter)
    for path in sorted(root.rglob("*.py")):
        packages[package_of(path.relative_to(root))] += lines_of(path.read_text(encoding="utf-8"))
    lines = {name: counts.total() for name, counts in packages.items()}
    tests = lines.pop("tests", 0)
    product = sum(n for name, n in lines.items() if name.split("/")[0] in PRODUCT)
    pages = [root / "README.md", *(root / "docs").rglob("*.md")]
    config = (root / "vslam" / "config.py").read_text(encoding="utf-8")
    with tempfile.TemporaryDirectory() as folder:
        build = [sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "-w", folder, str(root)]
        subprocess.run(build, check=True)
        (wheel,) = Path(folder).glob("*.whl")
        site = f"{folder}/site"
        pip = [sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--target", site]
        subprocess.run([*pip, str(wheel)], check=True)
        ask = [sys.executable, "-c", OPTIONS]
        environment = os.environ | {"PYTHONPATH": site}
        asked = subprocess.run(ask, env=environment, check=True, capture_output=True, text=True)
        of_run, of_all = asked.stdout.split()
        megabytes = wheel.stat().st_size / 1e6
    return packages, {
        "lines without tests": f"{sum(lines.values()):,}",
        f"of these in {', '.join(PRODUCT)}": f"{product:,}",
        "lines of tests": f"{tests:,}",
        "words of README and docs": f"{sum(len(p.read_text().split()) for p in pages):,}",
        "thresholds": str(thresholds(config)),
        "options of vslam run": of_run,
        "options of all commands": of_all,
        "wheel": f"{megabytes:.1f} MB",
    }


def table(head: Iterable[str], rows: Iterable[Iterable[object]]) -> str:
    lines = [" | ".join(map(str, row)) for row in (head, *rows)]
    lines.insert(1, " | ".join(["---"] * (lines[0].count(" | ") + 1)))
    return "\n".join(f"| {line} |" for line in lines)


def main() -> None:
    commits = sys.argv[1:] or ["HEAD"]
    found = []
    for commit in commits:
        with tempfile.TemporaryDirectory() as folder, tempfile.TemporaryDirectory() as index:
            command = ["git", f"--work-tree={folder}", "checkout", "--quiet", commit, "--", ":/"]
            environment = os.environ | {"GIT_INDEX_FILE": str(Path(index, "index"))}
            subprocess.run(command, cwd=ROOT, check=True, env=environment)
            found.append(measure(Path(folder)))
    for commit, (packages, _) in zip(commits, found, strict=True):
        rows = [[name, *(f"{packages[name][k]:,}" for k in KINDS)] for name in sorted(packages)]
        print(f"{table([commit, *KINDS], rows)}\n")
    names = found[0][1]
    print(table(["", *commits], [[name, *(one[name] for _, one in found)] for name in names]))


if __name__ == "__main__":
    main()
