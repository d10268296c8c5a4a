"""Seeded perturbations of a sequence: light, weather, glass, sensor and stereo rig.

A *law* is one kind of perturbation, for example fog. The strength of a law has a unit.
``docs/howto/stress.md`` lists all units. If the strength of a law has no unit, its default is 1.

In the following table, v is a grey value, s is the strength, t is the time in seconds since the
first frame, k is the index of the frame, and n is a standard normal random number.

============  ======================================================================================
brightness    v exp(g(t)) + b(t). g and b are Ornstein-Uhlenbeck processes with a time constant of
              two seconds. The standard deviation of g is 0.35 times the strength, and that of b is
              20 grey levels times the strength. Three times a minute on average, both processes
              jump, as when a car enters a tunnel: they are redrawn with 1.5 times the standard
              deviation. g is clipped to [-1.2, 0.7] max(1, s).
gamma         255 (v / 255)^exp(g(t)). g is a process as for brightness, but without jumps.
flicker       v exp(0.15 s n_k), with one n for each frame, as under mains lighting.
noise         v + 8 s n, with a separate n for each pixel, frame and camera.
blur          Gaussian blur with a standard deviation of 1.5 s pixels.
occlusion     A grey rectangle, like dirt on the glass, covers min(0.15 s, 0.9) of the image. Its
              place, shape and grey value are redrawn every second.
fog           Meteorological visibility (m), which is the distance at which the contrast falls to
              5 %. The depth is taken from the depth images if there are any. Otherwise it is
              computed by stereo matching (``depth.py``).
rain          Rainfall rate (mm/h). Falling drops appear as streaks. Other drops stick to the glass.
night         Number of stops by which the light is reduced. Photon noise and read noise are
              computed in electrons.
exposure      Time constant (s) with which auto-exposure follows a light that changes by 3 stops.
dark          255 A (v / 255)^(1 / gamma), as in Dark EuRoC (Xu et al., AirSLAM, T-RO 2025, eq. 22).
              Each level lowers either A by 0.15 or gamma by 0.1, in turn. The paper gives the rule
              but not these values. Between two levels, A and gamma are interpolated.
blackout      Period (s) in which the light goes out once. Two kinds of blackout alternate. In the
              first kind, the light is out for 0.16 s and then rises steadily for 0.64 s. In the
              second kind, the light is out for 0.32 s and rises for 0.4 s. The AirSLAM paper gives
              these times for two recordings of UMA-VI, but it does not give the period.
motion        Exposure time (ms), during which the rotation of the camera blurs the image. The
              angular rate is computed from the true poses if they are known, otherwise from the
              optical flow.
flare         Grey levels that the veiling glare of the sun adds at 10 degrees from the sun. The
              glare falls with 1 / angle^2 (Stiles-Holladay). Lens ghosts are added, too.
vignetting    Loss of light at the corners, in stops. The loss grows with the square of the distance
              from the centre.
dirt          % of the glass that is covered by blobs. The blobs do not change during the drive, but
              the two cameras have different blobs.
jpeg          Quality of the compression.
resolution    Remaining share of the width. The image is scaled up again.
drop          % of the frames that are dropped. Each frame is dropped independently of the others.
outage        Length (s) of an outage without frames, which happens once in every ten seconds.
bias          v + s grey levels.
contrast      Remaining % of the contrast about the mean of the image.
shot          Number of photons at a white pixel. A gain keeps the brightness unchanged.
impulse       % of the pixels that are black or white.
bits          Number of bits of a grey value.
stereo_gain   Stops by which the right image is darker.
desync        Delay (ms) of the right image. It is simulated by the optical flow to the next frame.
baseline      % by which the baseline is longer than calibrated.
yaw           Arc minutes by which the right camera is turned right, compared with the calibration.
pitch         Arc minutes by which the right camera is turned up, compared with the calibration.
black_right   % of the seconds in which the right image is black.
black_left    % of the seconds in which the left image is black.
imu-noise     White noise is added to the samples of the IMU: s times the densities of its
              calibration.
imu-bias      Bias of the gyroscope (degrees/s) in a random direction. That of the accelerometer, in
              another direction, is 0.1 m/s^2 for each degree/s.
imu-gap       Length (s) of a gap in the samples, which happens once in every ten seconds.
imu-delay     ms by which the times of the samples are late.
imu-axes      Angle (degrees) by which the IMU is turned about a random axis, compared with the
              calibration.
============  ======================================================================================

Each law rounds its result and clips it to 8 bits.

The laws of the IMU need recorded samples, and leave the images unchanged. The laws from stereo_gain
to black_left change the image of only one camera. All other laws change
both images in the same way. However, the random numbers for noise, night, shot, impulse, dirt and
drops on the glass are drawn separately for each camera.

The effect of a law on frame k depends only on the seed, on k and on the time of frame k. Therefore,
frames may be read in any order, and the result of a law does not depend on other laws. Laws of
plug-ins (docs/howto/plugins.md) must follow the same rule.
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
