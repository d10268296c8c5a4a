"""The report of a comparison of loop detectors: Markdown, HTML, JSON, the same numbers in each."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from matplotlib import style
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from vslam.errors import ResultsError
from vslam.lab.loopbench.measure import MIN_MATCHES, MIN_SHARE
from vslam.lab.loopbench.report_online import draw_online, online_tables, online_words
from vslam.lab.loopbench.schema import LoopsJson, Score
from vslam.lab.loopbench.sequences import LENGTH
from vslam.report.drawing import (
    AMBER,
    BLUE,
    GREEN,
    GREY,
    INK,
    RED,
    STYLE,
    VIOLET,
    ReportFigure,
    save,
)
from vslam.report.page import Table, markdown_table, render_page

MEAN = "mean of all"
_COLORS = [GREY, BLUE, VIOLET, AMBER, GREEN, RED]
_DASHES = ["-", "--", ":"]  # of the first six detectors, of the next six, of the rest
_ABOUT_AP = (
    "Average precision over all pairs of a query and a gallery image whose relation is known, "
    "descriptors alone. Last column: AP of the detector minus that of the first, with the 95 % "
    "interval of a bootstrap over the queries; * where it does not hold 0."
)
_ABOUT_RECALL = "Highest recall without one wrong pair; at a recall of 70 %, the precision."
_ABOUT_VERIFIED = (
    "Of the queries that have a place to find: share whose best image shows it, and shares where "
    f"also at least {MIN_MATCHES} ORB matches obey one epipolar geometry, where matches of learned "
    f"local descriptors that obey one homography cover {100 * MIN_SHARE:.0f} % of the image, and "
    "where one of both is so."
)
_ABOUT_SEQUENCES = (
    "Share of queries whose best image shows their place: by its score, and by the scores of a "
    f"sequence of {LENGTH} queries (SeqSLAM). Images without order have no sequences."
)
_ABOUT_WRONG = "Queries whose best image shows another place and passes those tests, too."
_ABOUT_ACCURACY = "Balanced: mean of the shares of true and of false pairs judged rightly by p."
_ABOUT_ACCEPTED = (
    "Of the pairs with p of at least 0.9; where there are none, precision counts as 1."
)
_ABOUT_COST = (
    "Each in a process of its own, one thread, medians. An image: what is needed beyond the ORB "
    "features that tracking has anyway. Parameters of bow: weights of its words."
)


def write_report(report: LoopsJson, out: Path) -> None:
    """Write ``loops.json``, ``loops.md`` and ``loops.html`` into ``out``.

    Raises:
        ResultsError: a file cannot be written.
    """
    page = render_page(
        "loops.html.jinja",
        report=report,
        title=title(report),
        words=words(report),
        tables=tables(report),
        made=_made(report),
        figures=draw(report),
    )
    try:
        out.mkdir(parents=True, exist_ok=True)
        (out / "loops.json").write_text(report.model_dump_json(indent=1) + "\n", encoding="utf-8")
        (out / "loops.md").write_text(markdown(report), encoding="utf-8")
        (out / "loops.html").write_text(page, encoding="utf-8")
    except OSError as error:
        raise ResultsError(
            f"{out}: the report cannot be written ({error.strerror}); name another folder."
        ) from error


def title(report: LoopsJson) -> str:
    """What was compared, in one line."""
    return f"Loop detectors: {', '.join(_detectors(report))}"


def markdown(report: LoopsJson) -> str:
    """Markdown whose tables are aligned, to be read in a terminal."""
    lines = [f"# {title(report)}", "", "## Who wins where", ""]
    lines += [*(f"- {sentence}" for sentence in words(report)), ""]
    for table in tables(report):
        lines += [f"## {table.title}", "", *markdown_table(table.head, table.rows), ""]
        lines += [table.note, ""] if table.note else []
    return "\n".join([*lines, "## Made", "", *markdown_table(("", ""), _made(report)), ""])


def words(report: LoopsJson) -> list[str]:
    """For each detector but the first and each condition, what the intervals say; for each drive,
    which detector decides best."""
    sentences = online_words(report.online)
    for first, second in dict.fromkeys((g.first, g.second) for g in report.gains):
        for condition in _conditions(report):
            gains = [g for g in report.gains
                     if (g.first, g.second, g.condition) == (first, second, condition)]  # fmt: skip
            better = [g.data for g in gains if g.low > 0]
            worse = [g.data for g in gains if g.high < 0]
            mean = float(np.mean([g.difference for g in gains]))
            said = [f"better on {', '.join(better)}"] if better else []
            said += [f"worse on {', '.join(worse)}"] if worse else []
            verdict = "; ".join(said) or "no difference beyond chance on any set"
            sentences.append(
                f"{condition}: {second} {mean:+.3f} AP against {first}, mean of {len(gains)} "
                f"{'sets' if len(gains) > 1 else 'set'}; {verdict}."
            )
    return sentences


def tables(report: LoopsJson) -> list[Table]:
    """Every table of the report."""
    if not report.cells:
        return online_tables(report.online)
    names = _detectors(report)
    texts = ("images", "condition")
    found = [
        Table("Average precision", (*texts, *names, *_gain_heads(report)), _ap_rows(report), texts,
              _ABOUT_AP),
        _table(report, "Recall at 100 % precision, precision at 70 % recall",
               lambda c: f"{c.figures['recall_at_100_precision']:.3f}, "
               f"{c.figures['precision_at_70_recall']:.3f}", _ABOUT_RECALL),
        _table(report, "Best image right, also verified by ORB, learned descriptors, one of both",
               lambda c: ", ".join(f"{share:.3f}" for share in
                                   (c.first_right, *(v.right for v in c.verified.values()))),
               _ABOUT_VERIFIED),
        _table(report, "Best image right, over a sequence",
               lambda c: f"{c.first_right:.3f}, " +
               ("-" if c.sequence_right is None else f"{c.sequence_right:.3f}"), _ABOUT_SEQUENCES),
        _table(report, "Wrong images verified by ORB, learned descriptors, one of both",
               lambda c: ", ".join(str(v.wrong) for v in c.verified.values()), _ABOUT_WRONG),
        _table(report, "Largest F1", lambda c: f"{c.figures['max_f1']:.3f}", ""),
        _table(report, "Accuracy at p = 0.5, 0.9", _accuracies, _ABOUT_ACCURACY),
        _table(report, "Precision, recall at p = 0.9",
               lambda c: "-" if c.accepted is None else
               f"{c.accepted[0]:.3f}, {c.accepted[1]:.3f}", _ABOUT_ACCEPTED),
    ]  # fmt: skip
    if report.costs:
        heads = [f"query of {n} (ms)" for n in report.costs[0].query_ms]
        rows = [
            (c.detector, f"{c.load_s:.2f}", f"{c.image_ms:.1f}",
             *(f"{ms:.2f}" for ms in c.query_ms.values()), f"{c.parameters / 1e6:.2f}",
             f"{c.memory_mb:.0f}")
            for c in report.costs
        ]  # fmt: skip
        head = ("detector", "load (s)", "image (ms)", *heads, "parameters (M)", "memory (MB)")
        found.append(Table("Cost", head, rows, ("detector",), _ABOUT_COST))
    return found


def _accuracies(score: Score) -> str:
    return ", ".join("-" if a is None else f"{a:.3f}" for a in score.accuracy.values())


def _gain_heads(report: LoopsJson) -> list[str]:
    return [f"{second} - {first}" for first, second in _compared(report)]


def _compared(report: LoopsJson) -> list[tuple[str, str]]:
    return list(dict.fromkeys((g.first, g.second) for g in report.gains))


def _ap_rows(report: LoopsJson) -> list[tuple[str, ...]]:
    ap = {(c.data, c.condition, c.detector): c.figures["average_precision"] for c in report.cells}
    gain = {(g.data, g.condition, g.second): g for g in report.gains}
    rows: list[tuple[str, ...]] = []
    for condition in _conditions(report):
        sets = [d for d in _data(report) if any(key[:2] == (d, condition) for key in ap)]
        for data in sets:
            row = [f"{ap[data, condition, name]:.3f}" for name in _detectors(report)]
            for _, second in _compared(report):
                g = gain[data, condition, second]
                star = "*" if g.low > 0 or g.high < 0 else ""
                row.append(f"{g.difference:+.3f} ({g.low:+.3f}, {g.high:+.3f}){star}")
            rows.append((data, condition, *row))
        means = [float(np.mean([ap[d, condition, name] for d in sets]))
                 for name in _detectors(report)]  # fmt: skip
        row = [f"{mean:.3f}" for mean in means]
        row += [f"{mean - means[0]:+.3f}" for mean in means[1:]]
        rows.append((MEAN, condition, *row))
    return rows


def _table(report: LoopsJson, name: str, shown: Callable[[Score], str], note: str) -> Table:
    names = _detectors(report)
    cells = {(c.data, c.condition, c.detector): shown(c) for c in report.cells}
    rows = [
        (data, condition, *(cells[data, condition, name] for name in names))
        for condition in _conditions(report)
        for data in _data(report)
        if (data, condition, names[0]) in cells
    ]
    return Table(name, ("images", "condition", *names), rows, ("images", "condition"), note)


def _detectors(report: LoopsJson) -> list[str]:
    names = [c.detector for c in report.cells] + [c.detector for c in report.online]
    return list(dict.fromkeys(names))


def _conditions(report: LoopsJson) -> list[str]:
    return list(dict.fromkeys(c.condition for c in report.cells))


def _data(report: LoopsJson) -> list[str]:
    return list(dict.fromkeys(c.data for c in report.cells))


def _made(report: LoopsJson) -> list[tuple[str, str]]:
    return [
        ("machine", report.machine),
        ("vslam", report.versions.get("vslam", "")),
        ("seed", str(report.seed)),
        ("created", f"{report.created:%Y-%m-%d %H:%M:%S %Z}"),
    ]


def draw(report: LoopsJson) -> list[ReportFigure]:
    """Precision-recall curves: a figure for each set of images, a panel for each condition; one
    figure for all drives."""
    figures = []
    with style.context(STYLE, after_reset=True):
        if report.online:
            figures.append(draw_online(report.online, _COLORS))
        for number, data in enumerate(_data(report)):
            cells = [c for c in report.cells if c.data == data]
            figure = _curves(cells, _detectors(report), data)
            caption = (
                f"Precision against recall on {data}, descriptors alone; a panel for each "
                "condition."
            )
            figures.append(save(f"precision_recall_{number}", caption, figure))
    return figures


def _curves(scores: list[Score], detectors: list[str], data: str) -> Figure:
    conditions = list(dict.fromkeys(c.condition for c in scores))
    columns = 2 if len(conditions) == 4 else min(3, len(conditions))
    rows = -(-len(conditions) // columns)
    figure = Figure(figsize=(6.6, 0.7 + 1.9 * rows), layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(data, x=0.01, ha="left", color=INK)
    grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    for axes in grid.flat[len(conditions) :]:
        axes.set_axis_off()
    for axes, condition in zip(grid.flat, conditions, strict=False):
        axes.set_title(condition, fontsize=9, color=INK)
        for score in (s for s in scores if s.condition == condition):
            dash, color = divmod(detectors.index(score.detector), len(_COLORS))
            axes.plot(score.curve.recall, score.curve.precision, label=score.detector,
                      color=_COLORS[color], linestyle=_DASHES[dash % len(_DASHES)])  # fmt: skip
        axes.set(xlim=(0, 1), ylim=(0, 1.02))
    handles, labels = grid[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=min(5, len(labels)))
    for axes in grid[-1, : (len(conditions) - 1) % columns + 1]:
        axes.set_xlabel("recall", fontsize=9.5)
    figure.supylabel("precision", fontsize=9.5)
    return figure
