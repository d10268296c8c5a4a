"""Registers vslam in VSLAM-LAB: copy this file to ``Baselines/baseline_files`` (README.md)."""

from __future__ import annotations

from typing import Any

from Baselines.BaselineVSLAMLab import BaselineVSLAMLab


class VslamBaseline(BaselineVSLAMLab):
    """vslam, which runs as the tasks ``execute-mono``, ``-stereo`` and ``-rgbd`` of ``pixi.toml``.

    The names of the class, of its attributes and of its methods are those of VSLAM-LAB.
    """

    def __init__(self) -> None:
        parameters = {"verbose": 0, "mode": "mono", "detector": "both"}
        super().__init__("vslam", "vslam", parameters)
        self.color = (0.1, 0.5, 0.3)
        self.modes = ["mono", "stereo", "rgbd"]
        self.camera_models = ["pinhole", "radtan4", "radtan5", "equid4"]

    def build_execute_command(self, exp_it: Any, exp: Any, dataset: Any, sequence_name: str) -> str:
        return str(self.build_execute_command_python(exp_it, exp, dataset, sequence_name))

    def is_installed(self) -> tuple[bool, str]:
        if (self.baseline_path / "install_vslam.txt").is_file():
            return True, "is installed"
        return False, "not installed (auto install available)"
