"""The networks by name, and where the weights that a run reads are."""

from __future__ import annotations

from pathlib import Path

from vslam.errors import InputError

NETWORKS = (
    "capsule", "capsule-pruned", "capsule-paper", "alexnet", "vgg16", "darknet19", "googlenet",
    "mobilenet", "squeezenet", "pcanet",
)  # fmt: skip
PRUNED = ("capsule-pruned", "capsule-paper")
"""Made from trained weights of ``capsule`` by removing primary capsules."""
TO_THE_LETTER = "capsule-paper"
"""The paper's own method: no keyframe image is kept, so neither odometry nor learned local
descriptors have a part in what it finds."""
SHIPPED = Path(__file__).parent / "weights"


def find_weights(name: str, weights: Path | None = None) -> Path:
    """The ONNX file of a detector.

    Args:
        name: one of ``NETWORKS``.
        weights: the file that the user names; None for the one that vslam ships.

    Raises:
        InputError: unknown name, or no such file.
    """
    if name not in NETWORKS:
        raise InputError(f"--detector {name}: unknown; choose one of {', '.join(NETWORKS)}.")
    path = weights or SHIPPED / f"{name}.onnx"
    if path.suffix == ".safetensors" and path.exists():
        raise InputError(
            f"--weights {path}: runs read ONNX files; write one with 'vslam export onnx --weights "
            f"{path}'."
        )
    if path.exists():
        return path
    if weights is None:
        raise InputError(
            f"--detector {name}: vslam ships no weights for it; train it with 'vslam train {name}' "
            "and name the .onnx file with --weights."
        )
    raise InputError(f"--weights {path}: not there; name the .onnx file of a training.")
