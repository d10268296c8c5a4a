"""Tables and figures of the documents: they are made, stamped, and compared with the pages."""

from __future__ import annotations

import importlib
import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
ENTRIES = """
[[figure]]
files = ["docs/research/plot.csv"]
reads = ["docs/research/drives.csv"]
run = 'cp docs/research/drives.csv $OUT/plot.csv'

[[figure]]
files = ["docs/research/drives.csv"]
seed = 3
run = '''
echo run >> runs.txt
printf '%s\\n' drive,system,ate_m,lost a,ours,0.1234,0 a,theirs,2.5,12 > $OUT/drives.csv
printf '%s\\n' b,ours,1234.5,0 b,theirs,,7 >> $OUT/drives.csv
'''
quick = "printf 'drive,system,ate_m,lost\\na,ours,1,0\\n' > $OUT/drives.csv"

[[figure]]
files = ["docs/research/real.csv"]
needs = ["NOWHERE_ROOT"]
run = "false"

[[figure]]
files = ["docs/research/finished.csv"]
history = "made by tools/finished.py of commit 01abcde"
"""
PAGE = """# Drives

<!-- from:
docs/research/drives.csv | drive=$1 | | ate_m (system=ours) | lost; ate_m (system=theirs)
-->
| drive | ours | theirs: lost, ATE |
|---|---|---|
| `a` | **0.12 m** | 12, 2.5 |
| b | 1,234.5 m | 7, none |

<!-- from: docs/research/drives.csv | system=ours | mean ate_m -->
In the mean it is 617.3 m. See [plot](docs/research/plot.csv).
"""


@pytest.fixture
def figures(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.syspath_prepend(str(ROOT / "tools"))
    return importlib.import_module("figures")


@pytest.fixture
def project(tmp_path: Path, figures, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A repository with four tables.

    Two tables can be made, one is from long ago, and one lacks its data.
    """
    monkeypatch.delenv("NOWHERE_ROOT", raising=False)
    root = tmp_path / "project"
    (root / "tools").mkdir(parents=True)
    (root / "docs/research").mkdir(parents=True)
    (root / "tools/figures.toml").write_text(ENTRIES)
    (root / "README.md").write_text(PAGE)
    (root / "docs/research/finished.csv").write_text("x\n1\n")
    for words in (["init", "-q"], ["add", "."], ["commit", "-qm", "Begin"]):
        names = ["-c", "user.name=x", "-c", "user.email=x@example.org"]
        subprocess.run(["git", *names, *words], cwd=root, check=True)
    return root


def test_every_table_here_has_a_stamp_and_pages_show_its_values(figures):
    assert figures.check(ROOT).faults == []


def test_tables_are_made_after_their_inputs_and_only_once(figures, project, capsys):
    assert figures.make(project, quick=False) == 0
    said = capsys.readouterr().out
    assert "real.csv: skipped; set NOWHERE_ROOT (datasets.md)" in said
    assert "finished.csv: kept (made by tools/finished.py of commit 01abcde)." in said
    assert figures.make(project, quick=False) == 0
    assert capsys.readouterr().out.count("up to date") == 2
    assert (project / "runs.txt").read_text() == "run\n"


def test_a_stamp_tells_how_a_table_was_made(figures, project):
    figures.make(project, quick=False)
    stamp = figures.read_stamps(project)["docs/research/drives.csv"]
    head = ["git", "rev-parse", "--short", "HEAD"]
    commit = subprocess.run(head, cwd=project, capture_output=True, text=True, check=True)
    assert stamp.commit == commit.stdout.strip()
    assert (stamp.method, stamp.seed) == (figures.METHOD_VERSION, 3)
    assert "cores" in stamp.machine
    assert "printf" in stamp.command


def test_quick_figures_are_written_elsewhere(figures, project, capsys):
    assert figures.make(project, quick=True) == 0
    assert "plot.csv: skipped, because it has no quick variant" in capsys.readouterr().out
    assert not (project / "docs/research/drives.csv").exists()
    assert "a,ours,1" in (project / "build/figures/docs/research/drives.csv").read_text()
    assert list(figures.read_stamps(project / "build/figures")) == ["docs/research/drives.csv"]


def test_a_failed_command_leaves_the_others_and_the_old_table(
    figures, project, monkeypatch, capsys
):
    monkeypatch.setenv("NOWHERE_ROOT", str(project))
    assert figures.make(project, quick=False) == 1
    assert "real.csv: FAILED" in capsys.readouterr().out
    assert (project / "docs/research/plot.csv").exists()


@pytest.fixture
def made(figures, project: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The project after all tables were made. Tables that are in git's history have stamps."""
    monkeypatch.setenv("NOWHERE_ROOT", str(project))
    entries = ENTRIES.replace('run = "false"', 'run = "echo x,y > $OUT/real.csv"')
    (project / "tools/figures.toml").write_text(entries)
    assert figures.make(project, quick=False) == 0
    assert figures.adopt(project) == ["docs/research/finished.csv"]
    return project


def test_a_table_of_another_version_is_listed_and_marked_on_its_page(figures, made):
    report = figures.check(made)
    assert report.faults == []
    (older,) = report.older
    assert older.startswith("docs/research/finished.csv: before version 1, commit ")
    assert "Older" not in figures.mark_older(made / "README.md", PAGE, made)

    stamps = figures.read_stamps(made)
    for name in ("drives", "plot"):
        stamps[f"docs/research/{name}.csv"] = replace(
            stamps[f"docs/research/{name}.csv"], method=figures.METHOD_VERSION - 1
        )
    figures.write_stamps(made, stamps)
    report = figures.check(made)
    assert report.faults == []
    on_readme = [line for line in report.older if line.endswith(", shown on README.md")]
    assert [line.partition(":")[0] for line in on_readme] == [*stamps][:1] + [*stamps][2:3]
    marked = figures.mark_older(made / "README.md", PAGE, made)
    before_the_table, _, _ = marked.partition("| drive |")
    version = f"version {figures.METHOD_VERSION - 1}"
    assert f"`docs/research/drives.csv`: {version}, commit" in before_the_table
    assert f"- `docs/research/plot.csv`: {version}, commit" in marked
    assert "finished.csv" not in marked

    assert figures.make(made, quick=False) == 0  # both tables are made again
    assert len(figures.check(made).older) == 1


def test_a_table_is_kept_by_a_version_that_gives_the_same_trajectories(figures, made):
    stamps = figures.read_stamps(made)
    drives, entry = "docs/research/drives.csv", figures.read_entries(made)[0]
    assert entry.files == (drives,)
    before = replace(stamps[drives], method=figures.METHOD_VERSION - 1)
    assert figures.is_older(before, entry)
    same = (figures.METHOD_VERSION - 1, figures.METHOD_VERSION)
    assert not figures.is_older(before, replace(entry, same_in=same))
    # A later version must be compared with them anew.
    past = tuple(version - 1 for version in same)
    assert figures.is_older(before, replace(entry, same_in=past))


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        ("a,ours,0.1234,0", "drives.csv: was changed after the run of its stamp"),
        (None, "README.md: source 'docs/research/drives.csv"),
    ],
)
def test_a_table_that_is_changed_by_hand_is_a_fault(figures, made, change, fault):
    table = made / "docs/research/drives.csv"
    if change is None:
        table.rename(made / "elsewhere.csv")
    else:
        table.write_text(table.read_text().replace(change, "a,ours,0.1,0"))
    assert any(fault in one for one in figures.check(made).faults)


def test_a_table_without_a_stamp_or_a_command_is_a_fault(figures, made):
    (made / "docs/research/new.csv").write_text("x\n1\n")
    stamps = figures.read_stamps(made)
    del stamps["docs/research/real.csv"]
    figures.write_stamps(made, stamps)
    unknown, unstamped = figures.check(made).faults
    assert unknown.startswith("docs/research/new.csv: name the command")
    assert unstamped.startswith("docs/research/real.csv: has no stamp")


@pytest.mark.parametrize(
    ("shown", "instead", "fault"),
    [
        ("**0.12 m**", "**0.13 m**", "'**0.13 m**' differs from [0.1234]"),
        ("12, 2.5", "12, 2.6", "'12, 2.6' differs from [12.0, 2.5]"),
        ("12, 2.5", "2.5", "'2.5' differs from"),
        ("7, none", "7, 0.1", "'7, 0.1' differs from [7.0]"),
        ("617.3 m", "617.9 m", "does not mention 617.3117 of docs/research/drives.csv"),
        (
            "| b |",
            "| c |",
            "0 rows of docs/research/drives.csv have {'drive': 'c', 'system': 'ours'}",
        ),
        ("drives.csv | drive=$1", "none.csv | drive=$1", "cannot be read"),
        ("ate_m (system=ours)", "ate (system=ours)", "cannot be read: 'ate'"),
        ("theirs)\n-->", "theirs)\n-\n-\n-->", "it has 3 lines, and the table has 2 rows"),
    ],
)
def test_a_page_that_differs_from_its_source_is_found(figures, made, shown, instead, fault):
    assert PAGE.count(shown) == 1
    (found,) = figures.sources.compare(PAGE.replace(shown, instead), made)
    assert fault in found


def test_new_numbers_are_written_into_the_tables_of_a_page(figures, made):
    table = made / "docs/research/drives.csv"
    rows = table.read_text().replace("0.1234", "0.5678").replace("1234.5", "98765.4")
    table.write_text(rows.replace("2.5,12", "2.5,13"))
    filled = figures.sources.fill(PAGE, made)
    assert "| `a` | **0.57 m** | 13, 2.5 |\n| b | 98,765.4 m | 7, none |\n" in filled
    # The numbers in sentences must be corrected by hand.
    (fault,) = figures.sources.compare(filled, made)
    assert "does not mention 49382.9" in fault


def test_pages_are_updated_when_their_tables_are_made(figures, made, capsys):
    page = made / "README.md"
    page.write_text(PAGE.replace("**0.12 m**", "**0.99 m**"))
    assert figures.make(made, quick=False) == 0
    assert "README.md: numbers updated." in capsys.readouterr().out
    assert page.read_text() == PAGE


def test_a_table_may_join_the_rows_of_several_files(figures, made):
    drives = made / "docs/research/drives.csv"
    head, *rows = drives.read_text().splitlines(keepends=True)
    drives.write_text(head + "".join(row for row in rows if ",ours," in row))
    other = made / "docs/research/other.csv"
    other.write_text(head + "".join(row for row in rows if ",ours," not in row))
    page = PAGE.replace("drives.csv | drive=$1", "drives.csv + docs/research/other.csv | drive=$1")
    assert list(figures.sources.compare(page, made)) == []
    comment = figures.sources.COMMENT.findall(page)[0]
    assert figures.sources.files_of(comment) == {
        "docs/research/drives.csv",
        "docs/research/other.csv",
    }


def test_a_cell_may_list_the_values_of_several_rows(figures, made):
    page = """<!-- from: docs/research/drives.csv | drive=$1 | | each ate_m -->
| drive | ATE of each system |
|---|---|
| a | 0.12, 2.6 |
| b | 1,234.5, nothing |
"""
    (fault,) = figures.sources.compare(page, made)
    assert "'0.12, 2.6' differs from [0.1234, 2.5]" in fault
    assert "| a | 0.12, 2.5 |\n| b | 1,234.5, nothing |\n" in figures.sources.fill(page, made)
    page = page.replace("2.6", "2.5").replace("| b | 1,234.5,", "| c |")
    (fault,) = figures.sources.compare(page, made)
    assert "0 rows of docs/research/drives.csv" in fault


def test_a_table_made_by_other_means_is_stamped_with_its_version(figures, made):
    table = made / "docs/research/drives.csv"
    table.write_text(table.read_text().replace("2.5,12", "2.54,12"))
    assert figures.adopt(made, figures.METHOD_VERSION) == ["docs/research/drives.csv"]
    report = figures.check(made)
    assert report.faults == []
    assert len(report.older) == 1
    figures.make(made, quick=False)
    assert "2.54,12" in table.read_text()  # it was not made again


def test_tables_without_a_source_are_listed(figures, made):
    page = made / "docs/research/typed.md"
    page.write_text(
        "| a | b |\n|---|---|\n| x | 0.5 |\n\n| words | alone |\n|---|---|\n| x | y |\n"
    )
    assert figures.check(made).typed == ["docs/research/typed.md: 1 of 2 tables"]


@pytest.mark.slow
def test_the_command_checks(made, figures, monkeypatch, capsys):
    monkeypatch.setattr(figures, "ROOT", made)
    monkeypatch.setattr(sys, "argv", ["figures.py", "--check"])
    with pytest.raises(SystemExit) as ended:
        figures.main()
    assert ended.value.code == 0
    assert "docs/research/finished.csv: before version 1" in capsys.readouterr().out
    (made / figures.STAMPS).write_text(json.dumps({}))
    with pytest.raises(SystemExit) as ended:
        figures.main()
    assert ended.value.code == 1
