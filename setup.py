"""The README as package registries show it: they have none of this repository's other files."""

import re
from pathlib import Path

from setuptools import setup

ROOT = Path(__file__).parent
SOURCE = re.compile(r"""^Source *= *["']([^"']+)""", re.MULTILINE)
LINK = re.compile(r"(!?)\[([^]]*)\]\((?!https?:|#)([^)\s]+)\)")


def published_readme() -> str:
    """Links within the repository lead to its page, if pyproject.toml names one (urls.Source);
    without one they are plain text, and pictures are left out."""
    # No tomllib, which Python 3.10 lacks: pip could not refuse an old Python in plain words.
    url = SOURCE.search((ROOT / "pyproject.toml").read_text("utf-8"))
    source = url[1].rstrip("/") if url else ""

    def replaced(found: re.Match[str]) -> str:
        picture, text, target = found.groups()
        if source:
            return f"{picture}[{text}]({source}/{'raw' if picture else 'blob'}/main/{target})"
        return "" if picture else text

    return LINK.sub(replaced, (ROOT / "README.md").read_text("utf-8"))


setup(long_description=published_readme(), long_description_content_type="text/markdown")
