"""The preset ``kitti-c``: the corruptions of RoboDepth's KITTI-C that vslam can apply.

KITTI-C (Kong et al., NeurIPS 2023) has 18 corruptions with 5 severities each. Most corruptions have
the parameters of ImageNet-C (Hendrycks and Dietterich, ICLR 2019). If a perturbation of vslam has
the same parameter as a corruption, its strengths are the values of KITTI-C. Otherwise, a note
describes the difference.
"""

from __future__ import annotations

from dataclasses import dataclass

from vslam.datasets.perturbation import parse_perturbation


@dataclass(frozen=True)
class Corruption:
    """One of the image corruptions that KITTI-C (Kong et al., NeurIPS 2023) defines.

    Attributes:
        specs: values of ``--perturb``, weakest first. Empty if vslam has no such perturbation.
        note: the difference between vslam's perturbation and the corruption of KITTI-C.
    """

    specs: tuple[str, ...]
    note: str = ""

    @property
    def perturbations(self) -> list[str]:
        """The values of ``--perturb`` in canonical spelling."""
        return [parse_perturbation(spec, 0).name for spec in self.specs]


def _specs(text: str, values: tuple[float, ...]) -> tuple[str, ...]:
    return tuple(text.format(value) for value in values)


_SIGMA = (0.08, 0.12, 0.18, 0.26, 0.38)  # standard deviation as a fraction of white

CORRUPTIONS: dict[str, Corruption] = {
    "brightness": Corruption(_specs("bias:{:g}", (25.5, 51.0, 76.5, 102.0, 127.5))),
    "dark": Corruption(
        _specs("night:{:g}", (0.74, 1.0, 1.32, 1.74, 2.32)),
        "light reduced to 0.6 to 0.2 with vslam's sensor noise; KITTI-C also squares the image",
    ),
    "fog": Corruption(
        _specs("fog:{:g}", (600, 300, 150, 75, 40)),
        "fog by distance, visibility 600 to 40 m; KITTI-C uses a cloud texture without depth",
    ),
    "frost": Corruption((), "no law"),
    "snow": Corruption((), "no law"),
    "contrast": Corruption(_specs("contrast:{:g}", (40, 30, 20, 10, 5))),
    "defocus_blur": Corruption(
        _specs("blur:{:g}", (1.0, 1.33, 2.0, 2.67, 3.33)),
        "Gaussian blur with the standard deviation of KITTI-C's discs of 3 to 10 pixels",
    ),
    "glass_blur": Corruption((), "no law"),
    "motion_blur": Corruption(
        _specs("motion:{:g}", (20, 40, 60, 80, 100)),
        "exposure of 20 to 100 ms at the true rotation; KITTI-C has a fixed direction and length",
    ),
    "zoom_blur": Corruption((), "no law"),
    "elastic_transform": Corruption((), "no law"),
    "color_quant": Corruption(_specs("bits:{:g}", (5, 4, 3, 2, 1)), "of grey values"),
    "gaussian_noise": Corruption(tuple(f"noise:{255 * s / 8:.3g}" for s in _SIGMA)),
    "impulse_noise": Corruption(_specs("impulse:{:g}", (3, 6, 9, 17, 27))),
    "shot_noise": Corruption(_specs("shot:{:g}", (60, 25, 12, 5, 3))),
    "iso_noise": Corruption(tuple(f"shot:25,noise:{0.7 * 255 * s / 8:.3g}" for s in _SIGMA)),
    "pixelate": Corruption(
        _specs("resolution:{:g}", (0.6, 0.5, 0.4, 0.3, 0.25)), "scaled up smoothly"
    ),
    "jpeg_compression": Corruption(_specs("jpeg:{:g}", (25, 18, 15, 10, 7))),
}
