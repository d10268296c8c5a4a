"""The README as package registries show it: they have none of this repository's other files."""

import platform
import re
import sys
from pathlib import Path

from setuptools import setup

try:
    import tomllib
except ModuleNotFoundError:  # pip runs this file before it compares requires-python
    sys.exit(f"vslam needs Python 3.11 or later; this is Python {platform.python_version()}.")

ROOT = Path(__file__).parent
LINK = re.compile(r"(!?)\[([^]]*)\]\((?!https?:|#)([^)\s]+)\)")


def published_readme() -> str:
    """Links within the repository lead to its page, if pyproject.toml names one (urls.Source);
    without one they are plain text, and pictures are left out."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    source = project.get("urls", {}).get("Source", "").rstrip("/")

    def replaced(found: re.Match[str]) -> str:
        picture, text, target = found.groups()
        if source:
            return f"{picture}[{text}]({source}/{'raw' if picture else 'blob'}/main/{target})"
        return "" if picture else text

    return LINK.sub(replaced, (ROOT / "README.md").read_text("utf-8"))


setup(long_description=published_readme(), long_description_content_type="text/markdown")
