"""The names of the networks, and the files that contain their weights."""

from __future__ import annotations

from pathlib import Path

from vslam.support.errors import InputError

NETWORKS = ("capsule", "capsule-pruned", "capsule-paper")
PRUNED = ("capsule-pruned", "capsule-paper")
"""Networks that were made from trained weights of ``capsule`` by removing primary capsules."""
TO_THE_LETTER = "capsule-paper"
"""The network that implements the method of the paper without additions.

No keyframe images are stored for this network. Therefore, neither odometry nor learned local
descriptors influence which loops it finds.
"""
SHIPPED = Path(__file__).parent / "weights"


def find_weights(name: str, weights: Path | None = None) -> Path:
    """Return the path of the ONNX file of a network.

    Args:
        name: one of ``NETWORKS``.
        weights: path that the user gave; None uses the file that vslam ships.

    Raises:
        InputError: the name is unknown, or there is no such file.
    """
    if name not in NETWORKS:
        raise InputError(f"--detector {name}: unknown; choose one of {', '.join(NETWORKS)}.")
    path = weights or SHIPPED / f"{name}.onnx"
    if not path.exists() and weights is None:
        raise InputError(
            f"--detector {name}: its weights are not part of an installed vslam; give the file "
            f"loopclosure/siamese/weights/{name}.onnx of the repository with --weights."
        )
    if not path.exists():
        raise InputError(
            f"--weights {path}: no such file; give the .onnx file of a trained network."
        )
    if path.suffix == ".safetensors":
        raise InputError(
            f"--weights {path}: a run needs an ONNX file; write one with 'vslam export onnx "
            f"--weights {path}'."
        )
    return path
