"""The web server of ``vslam report --serve``, which lists all runs in given folders.

The server can only be reached from this machine. A request names a report by its number, so that
the server never opens a path that comes from a request. Requests for a different host name are
rejected. Otherwise, a web site could read reports through the user's browser (DNS rebinding).

A report may come from an untrusted person and contain any script. Therefore, every report is
sandboxed: its scripts run in their own origin and cannot access other reports or the network.
Reports that are symbolic links are not read.
"""

from __future__ import annotations

import http.server
import re
import threading
from collections.abc import Collection, Sequence
from contextlib import suppress
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

from vslam.config import thresholds_in_words
from vslam.report.page import number
from vslam.report.render import fill_template
from vslam.report.schema import ReportJson
from vslam.support.errors import InputError
from vslam.support.untrusted import require_utf8
from vslam_lab.overview.collect import run_folders

HOST = "127.0.0.1"
_HOST_NAMES = (HOST, "localhost")
_MAX_COMPARED = 4
_LISTS_POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:; frame-src 'self'"
_REPORT_POLICY = (
    "sandbox allow-scripts; default-src 'none'; script-src 'unsafe-inline'; "
    "style-src 'unsafe-inline'; img-src data:"
)
_NUMBER = re.compile("[0-9]{1,9}")
_REPORT = re.compile("/run/([0-9]{1,9})")


def list_runs(folders: Collection[Path]) -> list[tuple[Path, ReportJson]]:
    """Find all runs below the folders and read their reports. The newest run comes first.

    Reports that cannot be read are left out.

    Raises:
        InputError: a folder does not exist, or no folder contains a run.
    """
    found: list[tuple[Path, ReportJson]] = []
    for folder in map(Path.resolve, run_folders(folders)):
        with suppress(InputError):
            require_utf8(folder)
            if _is_own(folder / "report.json"):
                found.append((folder, ReportJson.read(folder / "report.json")))
    if not found:
        raise InputError(f"{', '.join(map(str, folders))}: no run here; give folders of runs.")
    return sorted(found, key=lambda run: (run[1].created, run[0].name), reverse=True)


def _is_own(path: Path) -> bool:
    """Return whether a path is a regular file, and not a symbolic link."""
    return path.is_file() and path.resolve() == path


def make_server(folders: Sequence[Path], port: int = 0) -> http.server.ThreadingHTTPServer:
    """Make a server on the loopback interface that shows all runs below the given folders.

    Call its method ``serve_forever`` to start it. The folders are read again whenever a browser
    requests the list of runs.

    Args:
        port: port of the server; 0 for any free port.

    Raises:
        InputError: there is no run, or the port is in use.
    """
    pages = _Pages(folders)

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            host = (self.headers.get("Host") or "").partition(":")[0]
            status, text = pages.answer(self.path) if host in _HOST_NAMES else (403, "forbidden")
            is_ours = self.path.partition("?")[0] in ("/", "/compare")
            body = text.encode()
            self.send_response(status)
            for name, value in {
                "Content-Type": "text/html; charset=utf-8",
                "Content-Length": str(len(body)),
                "Content-Security-Policy": _LISTS_POLICY if is_ours else _REPORT_POLICY,
                "X-Content-Type-Options": "nosniff",
                "Cache-Control": "no-store",
            }.items():
                self.send_header(name, value)
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, format: str, *arguments: object) -> None:
            pass

    try:
        return http.server.ThreadingHTTPServer((HOST, port), Handler)
    except OSError as error:
        raise InputError(
            f"--port {port}: cannot be opened ({error.strerror}); choose another port."
        ) from error


class _Pages:
    """The pages of the server.

    The number of a report is its index in ``_known``. It never changes while the server runs.
    """

    def __init__(self, folders: Sequence[Path]) -> None:
        self._folders = folders
        self._known: list[Path] = []
        self._lock = threading.Lock()  # each request has its own thread
        self._list()

    def answer(self, request: str) -> tuple[int, str]:
        """Return the HTTP status and the page for a request (path with query string)."""
        try:
            url = urlsplit(request)
            if url.path == "/":
                with self._lock:
                    return 200, self._list()
        except ValueError:
            return 400, "bad request"
        except InputError:
            return 404, "the runs are gone"
        if found := _REPORT.fullmatch(url.path):
            return self._report(int(found[1]))
        if url.path == "/compare":
            chosen = [int(n) for n in parse_qs(url.query).get("run", []) if _NUMBER.fullmatch(n)]
            known = [n for n in dict.fromkeys(chosen) if n < len(self._known)][:_MAX_COMPARED]
            runs = [(n, self._known[n].parent.name) for n in known] if len(known) > 1 else []
            return 200 if runs else 400, fill_template("compare.html.jinja", runs=runs)
        return 404, "not found"

    def _report(self, number: int) -> tuple[int, str]:
        if number >= len(self._known) or not _is_own(self._known[number]):
            return 404, "not found"
        try:
            return 200, self._known[number].read_text("utf-8")
        except (OSError, UnicodeDecodeError):
            return 404, "the report is gone"

    def _list(self) -> str:
        rows = []
        for folder, report in list_runs(self._folders):
            page, number = folder / "report.html", None
            if _is_own(page):
                if page not in self._known:
                    self._known.append(page)
                number = self._known.index(page)
            rows.append((number, folder.name, _cells(report)))
        return fill_template("runs.html.jinja", head=_HEAD, rows=rows, most=_MAX_COMPARED)


_HEAD = ("data", "perturb", "detector", "frames", "lost", "ATE (m)", "loops", "wrong", "fps")


def _cells(report: ReportJson) -> tuple[str, ...]:
    return (
        f"{report.dataset} {report.sequence}, {report.sensor}",
        report.perturb,
        ", ".join(filter(None, (report.detector, thresholds_in_words(report.thresholds)))),
        f"{report.frames}{' (interrupted)' if report.interrupted else ''}",
        str(report.lost_frames),
        number(report.ate_rmse_m, "{:.3f}"),
        str(report.loops_closed),
        number(report.loops_wrong),
        f"{report.fps:.1f}",
    )
