"""The documentation site builds without warnings, needs no other host, and is correct."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote

import pytest
from browser import chromium, dumped

from vslam.calibration.files import read_calibration

pytest.importorskip("sphinx", reason="pip install 'vslam[docs]'")
ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
LOADS = {"script": "src", "img": "src", "iframe": "src", "source": "src", "link": "href"}


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site, which is built from a copy, because the build adds pages to docs/."""
    root = tmp_path_factory.mktemp("site")
    for name in ("docs", "backend", "loopclosure", "tools"):
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


def test_the_calibration_of_the_tutorial_is_read(tmp_path: Path):
    (text,) = re.findall(
        r"```yaml\n(.*?)```", (DOCS / "tutorial" / "own_camera.md").read_text(), re.S
    )
    (tmp_path / "camera.yaml").write_text(text)
    assert read_calibration([tmp_path / "camera.yaml"]).left.fx == 240.0


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
