"""Configuration of the documentation site, which Sphinx builds (``make docs``).

The site uses Sphinx with furo and MyST instead of MkDocs, for three reasons. The docstrings already
have Sphinx's roles. autodoc imports the package as it is installed, and three of its folders lie
outside ``vslam/``. The theme loads no fonts or scripts from other hosts.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
sys.path.insert(0, str(Path(__file__).parents[1] / "tools"))

import figures
from docutils import nodes
from site_reference import write_reference

from vslam import __version__

ROOT = Path(__file__).resolve().parent.parent
project, author, version = "vslam", "The vslam authors", __version__
copyright = author
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
exclude_patterns = ["notebooks"]
html_theme = "furo"
html_title = f"vslam {__version__}"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_copy_source = False
html_show_sphinx = False
pygments_style, pygments_dark_style = "tango", "monokai"
smartquotes = False  # two hyphens are the start of an option, not a dash
suppress_warnings = ["myst.header", "misc.highlighting_failure"]

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_default_options = {"members": True}
napoleon_use_ivar = True
napoleon_attr_annotations = False  # the signature has the types
default_role = "py:obj"
myst_heading_anchors = 4
myst_links_external_new_tab = False

# Pages whose files are outside docs/: path in the repository, and path on the site.
_PAGES = {
    "datasets.md": "reference/datasets.md",
    "CONTRIBUTING.md": "about/contributing.md",
    "CHANGELOG.md": "about/changelog.md",
    "loopclosure/vocabulary.md": "explanation/vocabulary.md",
    "backend/inertial.md": "explanation/inertial.md",
}
_LINK = re.compile(r"\[([^]]*)\]\((?!https?:|#|mailto:)([^)#\s]+)(#[^)\s]*)?\)")


def _mend_links(path: Path, text: str) -> str:
    """Turn links between files of the repository into links between pages of the site.

    A folder or a source file is named without a link.
    """

    def mended(found: re.Match[str]) -> str:
        words, link, anchor = found[1], found[2], found[3] or ""
        target = (path.parent / link).resolve()
        if not target.is_relative_to(ROOT):
            return found[0]
        name = target.relative_to(ROOT).as_posix()
        page = _PAGES.get(name) or (name.removeprefix("docs/") if name.startswith("docs/") else "")
        if target.is_dir() or not page:
            return words
        return f"[{words}](/{page}{anchor})"

    return _LINK.sub(mended, text)


def _read(app, docname, source):
    path = Path(app.srcdir) / f"{docname}.md"
    if not path.exists():
        return
    included = re.fullmatch(r"```\{include\} (\S+)\n```\n", source[0])
    if included:
        path = (path.parent / included[1]).resolve()
        source[0] = path.read_text()
    source[0] = _mend_links(path, figures.mark_older(path, source[0], ROOT))


_ARRAY = re.compile(
    r"~?numpy\.ndarray\[tuple\[~?(?:typing\.)?Any, \.\.\.\], ~?numpy\.dtype\[(.*?)\]\]"
)


def _shorten_signature(app, what, name, thing, options, signature, returned):
    """Write array types as in the source. Hide the constructors of protocols."""
    if getattr(thing, "_is_protocol", False):
        return "", ""
    return tuple(text and _ARRAY.sub(r"NDArray[\1]", text) for text in (signature, returned))


def _join_names(app, what, name, thing, options, lines):
    """Remove the spaces in lists of names such as ``fx, fy: focal lengths``.

    Otherwise, Sphinx would take the first name for a type.
    """
    for k, line in enumerate(lines):
        if line.startswith(":ivar "):
            names, colon, text = line.removeprefix(":ivar ").partition(":")
            lines[k] = f":ivar {names.replace(', ', ',')}{colon}{text}"


def _draw_dashes(app, doctree, docname):
    """Draw the dash between a parameter and its description, because ``smartquotes`` is off."""
    for text in list(doctree.findall(nodes.Text)):
        if text == " -- ":
            text.parent.replace(text, nodes.Text(" \N{EN DASH} "))


def setup(app):
    write_reference(Path(app.srcdir) / "reference")
    app.connect("source-read", _read)
    app.connect("autodoc-process-signature", _shorten_signature)
    app.connect("autodoc-process-docstring", _join_names, priority=600)  # after napoleon
    app.connect("doctree-resolved", _draw_dashes)
