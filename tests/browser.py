"""Renders pages in Chromium. Tests that use this module are skipped if Chromium is missing."""

from __future__ import annotations

import functools
import http.server
import shutil
import subprocess
import threading
from collections.abc import Callable
from pathlib import Path

import pytest


def chromium() -> str:
    """Return the path of the browser. The test is skipped if there is none."""
    found = next(
        filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
    )
    if found is None:
        pytest.skip("no Chromium here: apt-get install chromium")
    return found


def dumped(
    folder: Path,
    page: str,
    profile: Path,
    *,
    milliseconds: int,
    timeout: float = 180.0,
    on_request: Callable[[str], object] = lambda path: None,
) -> str:
    """Render a page of a folder, which is served locally, and return its HTML.

    Args:
        milliseconds: virtual time that the scripts of the page get.
        on_request: called with the path of each request.
    """
    flags = "--headless --no-sandbox --disable-gpu --disable-quic --no-first-run "
    flags += "--disable-background-networking --disable-component-update --disable-sync "
    flags += f"--virtual-time-budget={milliseconds} --dump-dom"
    command = [chromium(), *flags.split(), f"--user-data-dir={profile}"]

    class Handler(http.server.SimpleHTTPRequestHandler):
        def log_message(self, format, *arguments):
            on_request(self.path)

    handler = functools.partial(Handler, directory=str(folder))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        address = f"http://127.0.0.1:{server.server_port}/{page}"
        done = subprocess.run([*command, address], capture_output=True, text=True, timeout=timeout)
        server.shutdown()
    return done.stdout + done.stderr[-2000:]
