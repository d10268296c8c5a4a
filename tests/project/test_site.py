"""The documentation site builds without warnings, needs no other host, and is correct."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote

import numpy as np
import pytest
from browser import chromium, dumped
from source_files import write_calibration, write_video

from vslam.calibration.files import read_calibration

pytest.importorskip("sphinx", reason="pip install 'vslam[docs]'")
ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
TUTORIALS = sorted((DOCS / "tutorial").glob("*.md"))
PAGES = [p for p in sorted(DOCS.rglob("*.md")) if p.name != "commands.md"]
PAGES += [ROOT / "README.md", ROOT / "datasets.md"]
SHELL = re.compile(r"```sh\n(.*?)```", re.DOTALL)
LOADS = {"script": "src", "img": "src", "iframe": "src", "source": "src", "link": "href"}


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site, which is built from a copy, because the build adds pages to docs/."""
    root = tmp_path_factory.mktemp("site")
    for name in ("docs", "loopclosure", "tools"):
        shutil.copytree(ROOT / name, root / name, ignore=shutil.ignore_patterns("__pycache__"))
    for path in ROOT.glob("*.md"):
        shutil.copy(path, root)
    command = [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", "-b", "html"]
    done = subprocess.run(
        [*command, str(root / "docs"), str(root / "html")], capture_output=True, text=True, cwd=ROOT
    )
    assert (done.returncode, done.stderr) == (0, "")
    return root / "html"


class Page(HTMLParser):
    def __init__(self, path: Path) -> None:
        super().__init__()
        self.links: list[str] = []
        self.loaded: list[str] = []
        self.ids: set[str] = set()
        self.feed(path.read_text())

    def handle_starttag(self, tag, attrs):
        found = dict(attrs)
        self.ids |= {found.get("id") or ""}
        if tag == "a" and found.get("href"):
            self.links.append(found["href"])
        if tag in LOADS and found.get(LOADS[tag]):
            self.loaded.append(found[LOADS[tag]])


@pytest.fixture(scope="module")
def pages(site: Path) -> dict[Path, Page]:
    return {path: Page(path) for path in site.rglob("*.html")}


@pytest.mark.slow
def test_every_page_of_the_issue_is_there(pages, site):
    wanted = (
        "index tutorial/first_run tutorial/own_camera tutorial/report howto/plugins howto/kitti "
        "howto/euroc howto/tum howto/sources howto/bench howto/training reference/commands "
        "reference/modules reference/generated/vslam.slam explanation/design research/loops "
        "research/results"
    )
    assert {site / f"{name}.html" for name in wanted.split()} <= pages.keys()


@pytest.mark.slow
def test_no_link_within_the_site_is_broken(pages):
    broken = []
    for path, page in pages.items():
        for link in page.links:
            if re.match(r"[a-z]+:", link):
                continue
            file, _, anchor = unquote(link).partition("#")
            target = (path.parent / file).resolve() if file else path
            target = target / "index.html" if target.is_dir() else target
            wanted = anchor if target in pages else ""
            if not target.exists() or (wanted and wanted not in pages[target].ids):
                broken.append((path.name, link))
    assert broken == []


@pytest.mark.slow
def test_no_page_asks_another_host(pages, site):
    outside = [x for page in pages.values() for x in page.loaded if re.match(r"(https?:)?//", x)]
    assert outside == []
    for style in site.rglob("*.css"):
        assert not re.search(r"(@import|url\()\s*[\"']?(https?:)?//", style.read_text()), style


@pytest.mark.slow
def test_the_reference_has_every_command_and_option(site):
    from typer.main import get_command

    from vslam.cli.main import every_command
    from vslam.loopclosure.names import detector_names

    text = (site / "reference" / "commands.html").read_text()
    run = get_command(every_command()).commands["run"]  # type: ignore[attr-defined]
    assert all(option in text for parameter in run.params for option in parameter.opts)
    assert all(name in text for name in detector_names())
    assert 'id="vslam-loops-bench"' in text
    assert "<p>Run SLAM on a sequence" in text


def vslam_commands(text: str) -> list[list[str]]:
    """Return the words of every ``vslam`` command in the shell blocks of a page."""
    found = []
    for block in SHELL.findall(text):
        for line in block.replace("\\\n", " ").splitlines():
            try:
                words = shlex.split(line, comments=True)
            except ValueError:
                continue
            for k, word in enumerate(words):
                if word == "vslam" and (k == 0 or words[k - 1] in ("do", "&&", "then")):
                    ends = [w for w in range(k, len(words)) if words[w].strip(";") in ("", "&&")]
                    found.append(words[k : min([*ends, len(words)])])
    return found


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.name)
def test_commands_on_pages_exist_with_their_options(path: Path):
    from typer.main import get_command

    from vslam.cli.main import every_command

    for words in vslam_commands(path.read_text()):
        command, rest = get_command(every_command()), [word.rstrip(";") for word in words[1:]]
        while getattr(command, "commands", None) and rest and not rest[0].startswith("-"):
            assert rest[0] in command.commands, words  # type: ignore[attr-defined]
            command = command.commands[rest.pop(0)]  # type: ignore[attr-defined]
        known = {o for p in command.params for o in (*p.opts, *p.secondary_opts)} | {"--help"}
        used = {word.partition("=")[0] for word in rest if word.startswith("--")}
        assert used <= known, words


def test_the_reader_of_commands_sees_them():
    text = "```sh\nfor n in 1; do vslam run --seq 00 --out /tmp/$n; done\nvslam info  # x\n```"
    assert [words[:2] for words in vslam_commands(text)] == [["vslam", "run"], ["vslam", "info"]]


def test_the_calibration_of_the_tutorial_is_read(tmp_path: Path):
    (text,) = re.findall(
        r"```yaml\n(.*?)```", (DOCS / "tutorial" / "own_camera.md").read_text(), re.S
    )
    (tmp_path / "camera.yaml").write_text(text)
    assert read_calibration([tmp_path / "camera.yaml"]).left.fx == 240.0


@pytest.mark.slow
@pytest.mark.parametrize("path", TUTORIALS, ids=lambda path: path.stem)
def test_commands_of_the_tutorials_run(path: Path, corridor, tmp_path: Path):
    """Every shell block is run with fewer frames. The video shows the corridor of the tests."""
    pairs = [np.hstack(pair) for pair in zip(corridor.left, corridor.right, strict=True)]
    write_video(tmp_path / "drive.mkv", corridor.left[:12])
    write_video(tmp_path / "pair.mkv", pairs[:12])
    write_calibration(tmp_path / "camera.yaml", corridor.camera, mono=True)
    write_calibration(tmp_path / "stereo.yaml", corridor.camera)
    binaries = str(Path(sys.executable).parent)
    environment = os.environ | {"PATH": f"{binaries}:{os.environ['PATH']}"}
    for block in SHELL.findall(path.read_text()):
        short = re.sub(r"--max-frames \d+", "--max-frames 8", block)
        done = subprocess.run(
            ["bash", "-euo", "pipefail", "-c", short],
            cwd=tmp_path, env=environment, capture_output=True, text=True,
        )  # fmt: skip
        assert done.returncode == 0, block + done.stdout + done.stderr


_PROBE = """<!doctype html><meta charset="utf-8"><pre id="found"></pre>
<iframe id="page" width="400" height="900" style="border: 0"></iframe>
<script>
const pages = PAGES, found = [], page = document.getElementById("page");
const next = () => {
  if (!pages.length) {
    document.getElementById("found").textContent = "FOUND" + JSON.stringify(found) + "END";
    return;
  }
  page.onload = () => {
    const inner = page.contentDocument, root = inner.documentElement;
    found.push({
      page: page.src, shown: root.clientWidth, needed: root.scrollWidth,
      font: parseFloat(getComputedStyle(inner.querySelector("article p")).fontSize),
      outside: page.contentWindow.performance.getEntriesByType("resource").map(x => x.name)
        .filter(x => !x.startsWith(location.origin)),
    });
    next();
  };
  page.src = pages.shift();
};
next();
</script>"""


@pytest.mark.slow
def test_pages_in_a_browser_as_wide_as_a_phone(site: Path, tmp_path: Path):
    """At a width of 400 px, nothing is wider than the page, and letters are large enough.

    The pages request nothing from other hosts.
    """
    chromium()
    shown = ["index", "tutorial/first_run", "reference/commands", "reference/thresholds",
             "explanation/design", "howto/plugins", "reference/generated/vslam.slam",
             "research/results"]  # fmt: skip
    probe = _PROBE.replace("PAGES", json.dumps([f"{name}.html" for name in shown]))
    (site / "probe.html").write_text(probe)

    text = dumped(site, "probe.html", tmp_path / "profile", milliseconds=20000, timeout=240)
    answer = re.search("FOUND(.*)END</pre>", text)
    assert answer, text[-4000:]
    found = json.loads(answer[1].replace("&amp;", "&"))
    assert len(found) == len(shown)
    for page in found:
        assert page["needed"] <= page["shown"] <= 400, page
        assert page["font"] >= 14, page
        assert page["outside"] == [], page
