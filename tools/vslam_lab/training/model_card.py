"""Writes the model card, a file next to the weights of a network that describes how the weights
were trained."""

from __future__ import annotations

import json
import platform
import subprocess
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch

from vslam.support.errors import write_file
from vslam_lab.training.data import Collection
from vslam_lab.training.settings import TrainSettings
from vslam_lab.training.siamese import SiameseNetwork
from vslam_lab.training.training import TrainingOutcome


def describe(
    network: SiameseNetwork,
    collection: Collection,
    settings: TrainSettings,
    outcome: TrainingOutcome,
    *,
    preset: str,
    data: list[str],
    device: str,
) -> dict[str, Any]:
    """Collect the information that is needed to judge or reproduce the weights of a network."""
    return {
        "network": network.name,
        "parameters": network.n_parameters(),
        "dimensions": network.dimensions,
        "preset": preset,
        "seed": settings.seed,
        "data": data,
        "sources": dict(collection.sources),
        "images_trained": len(outcome.train),
        "images_validated": len(outcome.validation),
        "division": "whole units (folders, stretches of road), by seed; same places left out",
        "finished": outcome.finished,
        "epochs": outcome.progress.epoch,
        "best_epoch": max(
            range(len(outcome.progress.history)),
            key=lambda k: outcome.progress.history[k]["average_precision"],
            default=-1,
        ),
        "validation": outcome.figures,
        "seconds": round(outcome.progress.seconds, 1),
        "images_per_second": round(outcome.progress.images / max(outcome.progress.seconds, 1e-9)),
        "device": device,
        "machine": platform.processor() or platform.machine(),
        "torch": torch.__version__,
        "vslam": version("vslam"),
        "commit": _commit(),
        "settings": settings.model_dump(mode="json"),
    }


def write_card(card: dict[str, Any], weights: Path) -> tuple[Path, Path]:
    """Write a model card as ``NAME.json`` and ``NAME.md`` next to the weights. Returns the paths of
    both files."""
    figures = "".join(f"| {k} | {v:.4g} |\n" for k, v in card["validation"].items())
    sources = ", ".join(f"{k} ({v})" for k, v in card["sources"].items())
    paths = weights.with_suffix(".json"), weights.with_suffix(".md")
    text = (
        f"# {card['network']}\n\n"
        f"{card['parameters']:,} parameters, descriptor of {card['dimensions']} numbers. Preset "
        f"`{card['preset']}`, seed {card['seed']}, epochs trained: {card['epochs']}, best epoch: "
        f"{card['best_epoch']} (counted from 0). Trained for {card['seconds'] / 60:.1f} minutes on "
        f"{card['device']} ({card['machine']}), torch {card['torch']}, vslam {card['vslam']}, "
        f"commit {card['commit']}.\n\n"
        "## Validation\n\nEach augmented validation image is compared with all validation images. "
        f"All pairs with a known relation are used.\n\n| figure | value |\n|---|---|\n{figures}\n"
        f"## Data\n\nTrained on {card['images_trained']} images, validated on "
        f"{card['images_validated']}. Division: {card['division']}. No test data were used.\n\n"
        f"Images of each source: {sources}.\n\n"
        f"`{paths[0].name}` has the settings and the values of `--data`.\n"
    )
    write_file(paths[0], json.dumps(card, indent=2) + "\n")
    write_file(paths[1], text)
    return paths


def _commit() -> str:
    try:
        done = subprocess.run(
            ["git", "describe", "--always", "--dirty", "--abbrev=12"],
            capture_output=True, text=True, cwd=Path(__file__).parent, check=True, timeout=5,
        )  # fmt: skip
    except (OSError, subprocess.SubprocessError):
        return "unknown"
    return done.stdout.strip()
