"""Seeded perturbations of a sequence: light, weather, glass, sensor, stereo rig.

docs/howto/stress.md lists them with their units.

With v a grey value, s the strength, t seconds since the first frame, k the frame and n a standard
normal number. Laws without a unit have strength 1 unless ``law:s`` says otherwise:

============  ======================================================================================
brightness    v exp(g(t)) + b(t): g and b are Ornstein-Uhlenbeck walks of time constant 2 s and
              deviations 0.35 s and 20 s grey levels. Three times a minute on average both jump
              (tunnel, auto-exposure): they are drawn anew, 1.5 times as wide. g is clipped to
              [-1.2, 0.7] max(1, s).
gamma         255 (v / 255)^exp(g(t)): g is such a walk of deviation 0.35 s, without jumps.
flicker       v exp(0.15 s n_k): one n for each frame, as under mains lighting.
noise         v + 8 s n: one n for each pixel, frame and camera.
blur          Gaussian blur of deviation 1.5 s pixels.
occlusion     a grey rectangle, as of dirt on the glass, over min(0.15 s, 0.9) of the image's area;
              place, shape and grey value are drawn anew every second.
fog           meteorological visibility, m: at that distance contrast is 5 %. Depth is that
              of the data set's depth images, else of stereo matching (``depth.py``).
rain          mm/h: streaks of the drops that fall past the open shutter, drops on the glass.
night         stops of light less; photons and read noise are counted in electrons.
exposure      s: time constant of an auto-exposure behind a light that falls and rises by 3 stops.
motion        ms: the shutter is open while the camera turns, as fast as it truly does where poses
              are known, else as the image moves.
flare         grey levels of veil at 10 degrees from a sun, by 1 / angle^2 (Stiles-Holladay),
              with ghosts.
vignetting    stops at the corner, growing with the square of the distance from the middle.
dirt          % of the glass covered by blobs, others on each side, the same for the whole drive.
jpeg          quality of the compression.
resolution    share of the width that is left; the image is scaled up again.
drop          % of the frames, each on its own, do not come.
outage        s: once in each ten seconds no frames come for so long.
bias          v + s, grey levels.
contrast      % of the contrast about the mean of the image.
shot          photons that make white; the camera's gain makes up for what is missing.
impulse       % of the pixels are black or white.
bits          of a grey value.
stereo_gain   stops that the right side is darker.
desync        ms that the right side comes later, by optical flow to the next frame.
baseline      % that the rig is longer than its calibration.
yaw, pitch    arc minutes that the right camera is turned right, or up, against its calibration.
black_right   % of the seconds in which that side is black.
black_left    The same of the left side.
============  ======================================================================================

Each law rounds and clips to 8 bits, is the same for both cameras (noise, night, shot, impulse, dirt
and drops on the glass are drawn for each; the last six lines are faults of one side) and draws from
its own random stream: it does the same alone and in company, and what it does to frame k depends on
the seed, k and the time of k only, not on the frames asked for before. Laws of other packages
(docs/howto/plugins.md) are held to that, too. Walks live on a fixed grid
in time, so that dropping frames does not change the light. They are drawn as far as frames have
come: a stream may go on without end.
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
from vslam.datasets.perturbation.registry import LAWS, all_laws, law_kind
from vslam.datasets.perturbation.streams import ou_walk

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
