"""Seeded perturbations of a sequence: light, weather, glass, sensor and stereo rig.

A *law* is one kind of perturbation, for example fog. The strength of a law has a unit.
``docs/howto/stress.md`` lists all units. In this table, v is a grey value, s the strength, t the
time in seconds since the first frame, k the index of the frame, and n a standard normal random
number. The default strength of a law without a unit is 1.

============  ======================================================================================
brightness    v exp(g(t)) + b(t). g and b are Ornstein-Uhlenbeck processes with a time constant of
              two seconds. The standard deviation of g is 0.35 times the strength, and that of b is
              20 grey levels times the strength. Three times a minute on average, both processes
              jump, as at a tunnel or at a step of auto-exposure: they are redrawn with 1.5 times
              the standard deviation. g is clipped to [-1.2, 0.7] max(1, s).
gamma         255 (v / 255)^exp(g(t)). g is a process as for brightness, but without jumps.
flicker       v exp(0.15 s n_k), with one n for each frame, as under mains lighting.
noise         v + 8 s n, with one n for each pixel, frame and camera.
blur          Gaussian blur with a standard deviation of 1.5 s pixels.
occlusion     A grey rectangle, like dirt on the glass, covers min(0.15 s, 0.9) of the image. Its
              place, shape and grey value are redrawn every second.
fog           Meteorological visibility (m), which is the distance at which the contrast falls to
              5 %. The depth is taken from the depth images if there are any. Otherwise it is
              computed by stereo matching (``depth.py``).
rain          Rainfall rate (mm/h). The drops that fall during the exposure draw streaks, and other
              drops stick to the glass.
night         Number of stops by which the light is reduced. Photon noise and read noise are
              computed in electrons.
exposure      Time constant (s) with which auto-exposure follows a light that changes by 3 stops.
dark          255 A (v / 255)^(1 / gamma), as in Dark EuRoC (Xu et al., AirSLAM, T-RO 2025, eq. 22).
              Each level lowers either A by 0.15 or gamma by 0.1, in turn. The paper gives the rule
              but not these values. Between two levels, A and gamma are interpolated.
blackout      Period (s) in which the light goes out once. It is out for 0.16 s and then rises
              steadily for 0.64 s. The next time, it is out for 0.32 s and rises for 0.4 s. The
              AirSLAM paper gives these times for two recordings of UMA-VI, but not the period.
motion        Exposure time (ms), during which the rotation of the camera blurs the image. The
              angular rate is computed from the true poses if they are known, otherwise from the
              optical flow.
flare         Grey levels that the veiling glare of a sun adds at 10 degrees from it. The glare
              falls with 1 / angle^2 (Stiles-Holladay). Lens ghosts are added, too.
vignetting    Stops of light lost at the corner. The loss grows with the square of the distance from
              the centre.
dirt          % of the glass that is covered by blobs. The blobs differ between the two cameras and
              stay the same during the drive.
jpeg          Quality of the compression.
resolution    Remaining share of the width. The image is scaled up again.
drop          % of the frames that are dropped, independently of each other.
outage        Length (s) of an outage without frames, which happens once in every ten seconds.
bias          v + s grey levels.
contrast      Remaining % of the contrast about the mean of the image.
shot          Photons at white. A gain keeps the brightness.
impulse       % of the pixels that are black or white.
bits          Number of bits of a grey value.
stereo_gain   Stops by which the right image is darker.
desync        Delay (ms) of the right image. It is simulated by the optical flow to the next frame.
baseline      % by which the baseline is longer than calibrated.
yaw           Arc minutes by which the right camera is turned right from its calibrated rotation.
pitch         Arc minutes by which the right camera is turned up from its calibrated rotation.
black_right   % of the seconds in which the right image is black.
black_left    % of the seconds in which the left image is black.
============  ======================================================================================

Each law rounds its result and clips it to 8 bits.

The laws at the end of the table, beginning with stereo_gain, change the image of one camera. All
other laws change both images in the same way. However, noise, night, shot, impulse, dirt and drops
on the glass are drawn for each camera separately.

Each law draws from its own random stream, so that it does not depend on other laws. The effect of a
law on frame k depends only on the seed, on k and on the time of frame k. Therefore, frames may be
read in any order. Random processes are defined on a fixed grid in time, so that dropped frames do
not change the light. The processes are extended when frames arrive, so that a stream may be
endless. Laws of plug-ins (docs/howto/plugins.md) must follow the same rules.
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
