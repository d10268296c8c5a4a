"""A page of all runs in some folders, on this machine alone: ``vslam report --serve``.

Only reports that were found are served, by number: no path of a request reaches the disk. Requests
for another host's name are refused, so that no page of the web can read reports through the
browser (DNS rebinding).

A report may come from a stranger and hold any script. It is sandboxed: its scripts run in an origin
of their own and reach neither other reports nor the network. A ``report.html`` or ``report.json``
that is a link out of its folder is not read.
"""

from __future__ import annotations

import http.server
import re
import threading
from collections.abc import Collection, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

from vslam.errors import InputError
from vslam.lab.overview.collect import run_folders
from vslam.report.finished_run import read_report
from vslam.report.render import fill_template
from vslam.report.schema import ReportJson
from vslam.untrusted import require_utf8

HOST = "127.0.0.1"
_NAMES = (HOST, "localhost")
_MOST_BESIDE = 4
_LISTS_POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:; frame-src 'self'"
_REPORT_POLICY = (
    "sandbox allow-scripts; default-src 'none'; script-src 'unsafe-inline'; "
    "style-src 'unsafe-inline'; img-src data:"
)
_NUMBER = re.compile("[0-9]{1,9}")


@dataclass(frozen=True)
class ListedRun:
    """A run as the page lists it; ``page`` is None where it was made with ``--no-report``."""

    name: str
    report: ReportJson
    page: Path | None


def list_runs(folders: Collection[Path]) -> list[ListedRun]:
    """All runs in some folders, the newest first; what cannot be read is left out.

    Raises:
        InputError: no such folder, or no run in any of them.
    """
    found: list[ListedRun] = []
    for folder in run_folders(folders):
        place = folder.resolve()
        page = place / "report.html"
        with suppress(InputError):
            require_utf8(place)
            if _is_own(place / "report.json"):
                listed = page if _is_own(page) else None
                found.append(ListedRun(place.name, read_report(place), listed))
    if not found:
        raise InputError(f"{', '.join(map(str, folders))}: no run here; name folders of runs.")
    return sorted(found, key=lambda run: (run.report.created, run.name), reverse=True)


def _is_own(path: Path) -> bool:
    """Whether a path without links is a file, and not itself a link to another place."""
    return path.is_file() and path.resolve() == path


def make_server(folders: Sequence[Path], port: int = 0) -> http.server.ThreadingHTTPServer:
    """A server on the loopback interface, to be started by its ``serve_forever``.

    The folders are read anew whenever the list is asked for.

    Args:
        port: 0 for any that is free.

    Raises:
        InputError: no run, or the port is taken.
    """
    pages = _Pages(folders)

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            host = (self.headers.get("Host") or "").partition(":")[0]
            status, text = pages.answer(self.path) if host in _NAMES else (403, "forbidden")
            is_ours = self.path == "/" or self.path.startswith("/compare?")
            body = text.encode()
            self.send_response(status)
            self.send_header("Content-Type", "text/html; charset=utf-8")
            self.send_header("Content-Length", str(len(body)))
            policy = _LISTS_POLICY if is_ours else _REPORT_POLICY
            self.send_header("Content-Security-Policy", policy)
            self.send_header("X-Content-Type-Options", "nosniff")
            self.send_header("Cache-Control", "no-store")
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, format: str, *arguments: object) -> None:
            pass

    try:
        return http.server.ThreadingHTTPServer((HOST, port), Handler)
    except OSError as error:
        raise InputError(
            f"--port {port}: cannot be opened ({error.strerror}); name another one."
        ) from error


class _Pages:
    """What is answered; runs keep their number as long as the server lives."""

    def __init__(self, folders: Sequence[Path]) -> None:
        self._folders = folders
        self._numbers: dict[Path, int] = {}
        self._pages: list[Path] = []
        self._names: list[str] = []
        self._lock = threading.Lock()  # each request has its own thread
        self._list()

    def answer(self, request: str) -> tuple[int, str]:
        """Status and page for a path with its query."""
        try:
            url = urlsplit(request)
        except ValueError:
            return 400, "bad request"
        if url.path == "/":
            try:
                with self._lock:
                    return 200, self._list()
            except InputError:
                return 404, "the runs are gone"
        kind, _, number = url.path.strip("/").partition("/")
        if kind == "run" and _NUMBER.fullmatch(number):
            return self._run(int(number))
        if url.path == "/compare":
            chosen = [int(n) for n in parse_qs(url.query).get("run", []) if _NUMBER.fullmatch(n)]
            known = [n for n in dict.fromkeys(chosen) if n < len(self._names)][:_MOST_BESIDE]
            if len(known) > 1:
                beside = [(n, self._names[n]) for n in known]
                return 200, fill_template("compare.html.jinja", runs=beside)
            return 400, fill_template("compare.html.jinja", runs=[])
        return 404, "not found"

    def _run(self, number: int) -> tuple[int, str]:
        if number >= len(self._pages) or not _is_own(self._pages[number]):
            return 404, "not found"
        try:
            return 200, self._pages[number].read_text("utf-8")
        except (OSError, UnicodeDecodeError):
            return 404, "the report is gone"

    def _list(self) -> str:
        rows = []
        for run in list_runs(self._folders):
            number = None
            if run.page is not None:
                if run.page not in self._numbers:
                    self._numbers[run.page] = len(self._pages)
                    self._pages.append(run.page)
                    self._names.append(run.name)
                number = self._numbers[run.page]
            rows.append((number, run.name, _cells(run.report)))
        return fill_template("runs.html.jinja", head=_HEAD, rows=rows, most=_MOST_BESIDE)


_HEAD = ("data", "perturb", "detector", "frames", "lost", "ATE (m)", "loops", "wrong", "fps")


def _cells(report: ReportJson) -> tuple[str, ...]:
    ate = "n/a" if report.ate_rmse_m is None else f"{report.ate_rmse_m:.3f}"
    frames = f"{report.frames}{' (interrupted)' if report.interrupted else ''}"
    wrong = "n/a" if report.loops_wrong is None else str(report.loops_wrong)
    return (
        f"{report.dataset} {report.sequence}, {report.sensor}",
        report.perturb,
        report.detector,
        frames,
        str(report.lost_frames),
        ate,
        str(report.loops_closed),
        wrong,
        f"{report.fps:.1f}",
    )
