"""Decides whether a run of a stress test has failed."""

from __future__ import annotations

from dataclasses import dataclass

from vslam.report.schema import ReportJson

_LOSS_S = 10.0
_ERRORS_M = (10.0, 1.0)
ABSOLUTE = (
    "The column absolute says why the run also fails by the rules of AirSLAM (Xu et al., T-RO "
    f"2025). These rules allow losing track for at most {_LOSS_S:g} s. They allow an ATE of at "
    f"most {_ERRORS_M[0]:g} m (on OIVIO and UMA-VI) or {_ERRORS_M[1]:g} m (on Dark EuRoC)."
)


def absolute_verdict(report: ReportJson) -> str:
    """Return why a run exceeded the absolute limits (``ABSOLUTE``); empty if it did not."""
    if report.longest_loss_s is not None and report.longest_loss_s > _LOSS_S:
        return f"lost for {report.longest_loss_s:.0f} s"
    above = [limit for limit in _ERRORS_M if (report.ate_rmse_m or 0.0) > limit]
    return f"ATE above {above[0]:g} m" if above else ""


def lost_percent(report: ReportJson) -> float:
    """Return the percentage of lost frames among the frames that were not dropped."""
    return 100.0 * report.lost_frames / max(1, report.frames - report.dropped_frames)


@dataclass(frozen=True)
class Criterion:
    """The limits beyond which a run counts as failed.

    ``ate_factor`` is relative to the *clean run*: the run of the same system on unperturbed images.

    Attributes:
        lost_percent: largest allowed percentage of lost frames. Dropped frames are not counted.
        ate_factor: largest allowed ratio of the run's ATE to the clean run's ATE.
        ate_least_m: ATE in metres that is always allowed, even if the clean run has a very small
            ATE.
    """

    lost_percent: float = 5.0
    ate_factor: float = 3.0
    ate_least_m: float = 0.25

    @property
    def words(self) -> str:
        """The limits in one sentence."""
        return (
            f"A run fails if more than {self.lost_percent:g} % of its frames are lost, if its ATE "
            f"is above {self.ate_least_m:g} m and above {self.ate_factor:g} times the ATE of the "
            "same system on clean images, if it closes more wrong loops or finds fewer revisits "
            "than on clean images, or if it ends with an error."
        )

    def verdict(self, report: ReportJson, clean: ReportJson) -> str:
        """Return why a run failed; an empty text if it did not fail."""
        if (lost := lost_percent(report)) > self.lost_percent:
            return f"{lost:.0f} % lost"
        limit = self.ate_limit(clean)
        if limit is not None and (report.ate_rmse_m is None or report.ate_rmse_m > limit):
            ate = "unknown" if report.ate_rmse_m is None else f"{report.ate_rmse_m:.3g} m"
            return f"ATE {ate}"
        if (report.loops_wrong or 0) > (clean.loops_wrong or 0):
            return "wrong loop"
        if (clean.loops_found or 0) > (report.loops_found or 0):
            return "revisit missed"
        return ""

    def ate_limit(self, clean: ReportJson) -> float | None:
        """Return the largest allowed ATE in metres; None if the clean run has no ATE."""
        if clean.ate_rmse_m is None:
            return None
        return max(self.ate_least_m, self.ate_factor * clean.ate_rmse_m)
