"""The report of one run: JSON for scripts, Markdown for the terminal, HTML and PNG for people."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from vslam.evaluate import Evaluation
    from vslam.run import RunOutcome

__all__ = ["write_report"]


def write_report(
    outcome: RunOutcome, evaluation: Evaluation | None, folder: Path, *, pages: bool = True
) -> None:
    """Write everything that is known of a run, in any state of completion, into ``folder``.

    Files: ``report.json``, ``report.md``, ``report.html`` (one file, no network request),
    ``figures/*.png``, ``frames.csv``, ``config.json`` (read by ``--config``), ``keyframes.tum`` and
    the files of :func:`vslam.runfolder.write_trajectories`.

    Args:
        outcome: the run; it may be interrupted, all lost, or without a single frame.
        evaluation: of ``outcome.trajectory``, frame by frame; None without ground truth.
        folder: an existing folder; what is written replaces files of an earlier report.
        pages: write what people read, too: Markdown, HTML and figures.

    Raises:
        OSError: a file cannot be written.
    """
    from vslam.evaluate import evo_command
    from vslam.loop_evaluation import evaluate_loops
    from vslam.report.frames import write_frames
    from vslam.report.summary import summarize
    from vslam.runfolder import matched_ground_truth, write_trajectories
    from vslam.trajectory import write_tum

    config = outcome.settings.config.model_dump_json(indent=2) + "\n"
    (folder / "config.json").write_text(config)
    write_trajectories(folder, outcome)
    write_tum(folder / "keyframes.tum", outcome.keyframes)
    write_frames(folder / "frames.csv", outcome.tracks)

    command = None
    if evaluation is not None:
        estimate, ground_truth = (
            folder / f"{name}_kitti.txt" for name in ("trajectory", "ground_truth")
        )
        command = evo_command(estimate, ground_truth, evaluation.alignment)
    verdict = evaluate_loops(outcome)
    report = summarize(outcome, evaluation, verdict, command)
    (folder / "report.json").write_text(report.model_dump_json(indent=2) + "\n", encoding="utf-8")
    if not pages:
        return

    from vslam.report.figures import draw_figures
    from vslam.report.render import render_html, render_markdown

    (folder / "report.md").write_text(render_markdown(report), encoding="utf-8")
    figures = draw_figures(outcome, evaluation, matched_ground_truth(outcome), verdict)
    (folder / "figures").mkdir(exist_ok=True)
    for figure in figures:
        (folder / "figures" / f"{figure.name}.png").write_bytes(figure.png)
    (folder / "report.html").write_text(render_html(report, config, figures), encoding="utf-8")
