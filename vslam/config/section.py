"""What all sections of the configuration have in common."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict


class Section(BaseModel):
    """A frozen group of thresholds; the docstring below each field describes it.

    ``tools/threshold_table.py`` reads these docstrings from the source. Pydantic could do so itself
    (``use_attribute_docstrings``), but that would take 0.1 s at the start of every run.

    A docstring ends with the source of the value in brackets: [own], or the paper and section of
    the rule and the status of the value: printed there, customary in the programs of the ORB-SLAM
    family, or our own.

    OS1: Mur-Artal et al., ORB-SLAM, T-RO 2015. OS2: Mur-Artal and Tardós, ORB-SLAM2, T-RO 2017.
    ZS: Zhou and Sun, Sci Rep 15, 7644 (2025).
    """

    model_config = ConfigDict(frozen=True, extra="forbid")
