"""The documents name only things that exist, and contain no paths of a machine."""

from __future__ import annotations

import ast
import csv
import re
import subprocess
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parents[2]
GENERATED = ROOT / "docs" / "reference"  # commands.md and generated/, when the site is built
DOCUMENTS = sorted(
    path
    for path in [
        *ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"),
        *(ROOT / "loopclosure").glob("*.md"), *(ROOT / "backend").glob("*.md"),
    ]
    if path.name != "commands.md" and GENERATED / "generated" not in path.parents
)  # fmt: skip
LINK = re.compile(r"\]\((?!https?:|#)([^)#\s]+)[^)]*\)")
SOURCE = re.compile(
    r"`((?:vslam|frontend|backend|loopclosure|tools|tests|docs)/[\w./-]+\.(?:py|md|csv|json|npy|npz|html))"
)
IN_HISTORY = re.compile(r"kept in the (?:Git )?history\W+commit ([0-9a-f]{7,})")


def name(path: Path) -> str:
    return str(path.relative_to(ROOT))


@pytest.mark.parametrize("document", DOCUMENTS, ids=name)
def test_links_and_files_named_exist(document):
    text = document.read_text()
    links = [link for link in LINK.findall(text) if not link.endswith("reference/commands.md")]
    missing = [link for link in links if not (document.parent / link).exists()]
    missing += [file for file in files_named(text) if not (ROOT / file).exists()]
    assert missing == []


def files_named(text: str) -> list[str]:
    """Return the files that a page names, without scripts that are only in git's history."""
    lines = [line for line in text.splitlines() if not IN_HISTORY.search(line)]
    return SOURCE.findall("\n".join(lines))


def test_what_is_kept_in_the_history_is_there():
    for line in "\n".join(document.read_text() for document in DOCUMENTS).splitlines():
        for commit in IN_HISTORY.findall(line):
            if not is_in_history(commit):
                pytest.skip("the clone is shallow, or no repository")
            for file in SOURCE.findall(line):
                assert (ROOT / file).exists() or is_in_history(f"{commit}:{file}"), file


def is_in_history(what: str) -> bool:
    """Return whether git has a commit, or a file in a commit (``COMMIT:FILE``)."""
    return not subprocess.run(
        ["git", "cat-file", "-e", what], cwd=ROOT, check=False, capture_output=True
    ).returncode


def test_a_missing_file_would_be_seen():
    text = "[a](docs/none.md) and `vslam/none.py`, not [b](https://x.org) or [c](#d)"
    assert LINK.findall(text) == ["docs/none.md"]
    assert files_named(text) == ["vslam/none.py"]
    assert files_named("`vslam/none.py`, which is kept in the history (commit 01abcde)") == []


@pytest.mark.parametrize("document", DOCUMENTS, ids=name)
def test_no_path_of_a_machine_and_no_conflict_of_a_merge(document):
    text = document.read_text()
    assert re.findall(r"(?<![\w.}$~])/(?:home|root|work|Users)/\S+", text) == []
    assert re.findall(r"^(?:<{7}|>{7}) .*", text, re.MULTILINE) == []


def test_the_readme_is_short():
    text = re.sub(r"<!--.*?-->", "", (ROOT / "README.md").read_text(), flags=re.DOTALL)
    assert len(text.split()) <= 950


def test_tests_that_documents_name_exist():
    defined = {
        node.name
        for path in (ROOT / "tests").rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.FunctionDef)
    }
    named = {
        test
        for document in DOCUMENTS
        for test in re.findall(r"`(test_\w+)`", document.read_text())
        if not list((ROOT / "tests").rglob(f"{test}.py"))
    }
    assert named - defined == set()


def test_the_example_of_the_readme_runs():
    import numpy as np

    (example,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    grey = np.random.default_rng(0).integers(0, 256, (376, 1241), dtype=np.uint8)
    values: dict[str, object] = {"frames": [(grey, np.roll(grey, -8, axis=1), 0.0)]}
    exec(compile(example, "README.md", "exec"), values)
    assert len(values["trajectory"]) == 1  # type: ignore[arg-type]


@pytest.mark.parametrize("table", sorted((ROOT / "docs").rglob("*.csv")), ids=name)
def test_tables_are_rectangular(table):
    rows = list(csv.reader(table.open(encoding="utf-8")))
    assert len(rows) > 1
    assert {len(row) for row in rows} == {len(rows[0])}


def test_the_table_of_modules_is_made_from_their_docstrings(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "docs"))
    from site_reference import module_rows

    page = (GENERATED / "modules.md").read_text()
    assert [line for line in page.splitlines() if line.startswith("| [")] == module_rows()


def test_citation_is_of_this_version():
    from vslam import __version__

    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert citation["version"] == __version__
    assert citation["license"] == "Apache-2.0"
    assert len(citation["references"]) == 2
