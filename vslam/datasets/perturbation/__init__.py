"""Seeded perturbations of a sequence: light, weather, glass, sensor and stereo rig.

Each perturbation follows a law, which ``docs/howto/stress.md`` lists with its unit. In this table,
v is a grey value, s the strength, t the time in seconds since the first frame, k the index of the
frame and n a standard normal number. Laws without a unit have strength 1 by default:

============  ======================================================================================
brightness    v exp(g(t)) + b(t): g and b are Ornstein-Uhlenbeck processes with a time constant of
              two seconds; their standard deviations are 0.35 s and 20 s (grey levels). Three times
              a minute on average, both jump, as at a tunnel or a step of auto-exposure: they are
              redrawn with 1.5 times the deviation. g is clipped to [-1.2, 0.7] max(1, s).
gamma         255 (v / 255)^exp(g(t)): g is a process as for brightness, but without jumps.
flicker       v exp(0.15 s n_k): one n for each frame, as under mains lighting.
noise         v + 8 s n: one n for each pixel, frame and camera.
blur          Gaussian blur with a standard deviation of 1.5 s pixels.
occlusion     a grey rectangle, like dirt on the glass, over min(0.15 s, 0.9) of the image's area;
              place, shape and grey value are redrawn every second.
fog           meteorological visibility (m), the distance at which the contrast falls to 5 %. Depth
              comes from the depth images if there are any, else from stereo matching
              (``depth.py``).
rain          rate in mm/h: streaks of drops that fall during the exposure, and drops on the glass.
night         stops of lost light; photon and read noise are computed in electrons.
exposure      time constant (s) with which auto-exposure follows a light that changes by 3 stops.
dark          255 A (v / 255)^(1 / gamma), as in Dark EuRoC (Xu et al., AirSLAM, T-RO 2025, eq. 22):
              each level lowers A by 0.15 or gamma by 0.1, in turn. The paper gives the rule but not
              these values. Between two levels, A and gamma are interpolated.
blackout      period (s) in which the light goes out once. It is out for 0.16 s and then rises
              steadily for 0.64 s; the next time, it is out for 0.32 s and rises for 0.4 s. The
              AirSLAM paper gives these times for two recordings of UMA-VI, but not the period.
motion        exposure time (ms), during which the camera turns and blurs the image. The angular
              rate comes from the true poses if they are known, else from the optical flow.
flare         veiling glare (grey levels) at 10 degrees from a sun, which falls with 1 / angle^2
              (Stiles-Holladay), and lens ghosts.
vignetting    stops at the corner, growing with the square of the distance from the centre.
dirt          % of the glass that blobs cover, different on each side, constant during the drive.
jpeg          quality of the compression.
resolution    remaining share of the width; the image is scaled up again.
drop          % of the frames that are dropped, independently of each other.
outage        length (s) of an outage without frames in every ten seconds.
bias          v + s grey levels.
contrast      remaining % of the contrast about the mean of the image.
shot          photons at white; a gain keeps the brightness.
impulse       % of the pixels that are black or white.
bits          number of bits of a grey value.
stereo_gain   stops by which the right image is darker.
desync        delay (ms) of the right image, simulated by optical flow to the next frame.
baseline      % by which the baseline is longer than calibrated.
yaw, pitch    arc minutes by which the right camera is turned right, or up, from its calibration.
black_right   % of the seconds in which the right image is black.
black_left    % of the seconds in which the left image is black.
============  ======================================================================================

Each law rounds and clips to 8 bits. The laws from stereo_gain on change the image of one camera.
All other laws change both images alike, but noise, night, shot, impulse, dirt and drops on the
glass are drawn for each camera separately. Each law draws from its own random stream, so that it
does not depend on other laws. The effect of a law on frame k depends only on the seed, on k and on
the time of frame k, not on the order in which frames are read. Laws of other packages
(docs/howto/plugins.md) must follow the same rules. Random processes are defined on a fixed grid in
time, so that dropped frames do not change the light, and are extended as frames arrive, so that a
stream may be endless.
"""

from __future__ import annotations

from vslam.datasets.perturbation.kinds import Law, LawKind, Pair, PairLaw, Scene
from vslam.datasets.perturbation.laws import (
    Perturbation,
    contact_sheet,
    laws_for,
    parse_perturbation,
    perturbed,
    sheet_of_laws,
)
from vslam.datasets.perturbation.light import ou_walk
from vslam.datasets.perturbation.registry import LAWS, all_laws, law_kind

__all__ = [
    "LAWS",
    "Law",
    "LawKind",
    "Pair",
    "PairLaw",
    "Perturbation",
    "Scene",
    "all_laws",
    "contact_sheet",
    "law_kind",
    "laws_for",
    "ou_walk",
    "parse_perturbation",
    "perturbed",
    "sheet_of_laws",
]
