"""Motion blur that the rotation of the camera causes during the exposure.

Other perturbations also use the functions that compute the velocities of the camera and of the
image.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vslam.datasets.perturbation.kinds import EachSide, LawKind, PairLaw, RandomStream, Scene
from vslam.types.camera import Image

_SHRINK = 2


def optical_flow(first: Image, second: Image) -> NDArray[np.float32]:
    """Compute the optical flow between two images at half size.

    The method is dense inverse search (Kroeger et al., ECCV 2016).

    Returns:
        ``(H, W, 2)`` displacement of each pixel from ``first`` to ``second``, in pixels.
    """
    import cv2

    height, width = first.shape
    size = max(16, width // _SHRINK), max(16, height // _SHRINK)
    one, two = (cv2.resize(i, size, interpolation=cv2.INTER_AREA) for i in (first, second))
    matcher = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST)
    flow = cv2.resize(
        matcher.calc(one, two, np.zeros((*one.shape, 2), np.float32)), (width, height)
    )
    scale = np.array([width / size[0], height / size[1]], np.float32)
    return np.asarray(flow * scale, np.float32)


def neighbours(scene: Scene, frame: int) -> tuple[int, int]:
    """Return the indices of the frames before and after a frame.

    If there is no previous or next frame, the frame's own index takes its place.
    """
    assert scene.times is not None
    return max(0, frame - 1), min(len(scene.times) - 1, frame + 1)


def image_velocity(scene: Scene, frame: int) -> NDArray[np.float64]:
    """Return the ``(2,)`` velocity (px/s) with which the rotation moves the image centre.

    The velocity is computed from the true rotation if it is known, otherwise from the median
    optical flow to the next frame, which also contains the effect of the forward motion.
    """
    assert scene.times is not None
    assert scene.read is not None
    previous, following = neighbours(scene, frame)
    elapsed = float(scene.times[following] - scene.times[previous])
    if elapsed <= 0:
        return np.zeros(2)
    R_wc = None if scene.T_wc is None else scene.T_wc[[previous, following], :3, :3]
    if R_wc is not None and np.isfinite(R_wc).all():
        from scipy.spatial.transform import Rotation

        rotation = Rotation.from_matrix(R_wc[0].T @ R_wc[1]).as_rotvec()
        return scene.camera.fx * np.array([-rotation[1], rotation[0]]) / elapsed
    pair = (frame, following) if following > frame else (previous, frame)
    flow = optical_flow(*(scene.read(k)[0] for k in pair))
    step = float(scene.times[pair[1]] - scene.times[pair[0]])
    return np.median(flow.reshape(-1, 2), axis=0).astype(np.float64) / step


def forward_speed(scene: Scene, frame: int) -> float:
    """Return the forward speed of the camera in metres per second; 0 if it is unknown."""
    if scene.times is None or scene.T_wc is None:
        return 0.0
    previous, following = neighbours(scene, frame)
    elapsed = float(scene.times[following] - scene.times[previous])
    T = scene.T_wc[[previous, following]]
    if elapsed <= 0 or not np.isfinite(T).all():
        return 0.0
    return float((T[0, :3, :3].T @ (T[1, :3, 3] - T[0, :3, 3]))[2] / elapsed)


def line_kernel(shift: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return the weights of a centred filter for motion blur along a straight line.

    Args:
        shift: ``(2,)`` displacement in x and y during the exposure, in pixels.
    """
    reach = int(np.ceil(np.abs(shift).max() / 2.0)) + 1
    kernel = np.zeros((2 * reach + 1, 2 * reach + 1))
    n = max(2, int(4 * np.hypot(*shift)) + 1)
    for x, y in reach + np.linspace(-0.5, 0.5, n)[:, None] * shift:
        x0, y0 = int(x), int(y)
        dx, dy = x - x0, y - y0
        kernel[y0, x0] += (1 - dx) * (1 - dy)
        kernel[y0, x0 + 1] += dx * (1 - dy)
        kernel[y0 + 1, x0] += (1 - dx) * dy
        kernel[y0 + 1, x0 + 1] += dx * dy
    return (kernel / kernel.sum()).astype(np.float32)


def _motion(shutter_ms: float, stream: RandomStream, scene: Scene) -> PairLaw:
    def law(frame: int, t: float, side: int, image: Image) -> Image:
        import cv2

        shift = image_velocity(scene, frame) * shutter_ms / 1e3
        if np.hypot(*shift) < 0.1:
            return image
        kernel = line_kernel(np.clip(shift, -400.0, 400.0))
        return np.asarray(
            cv2.filter2D(image, -1, kernel, borderType=cv2.BORDER_REPLICATE), np.uint8
        )

    return EachSide(law)


KINDS = {
    "motion": LawKind(
        _motion, "ms", 50.0, 1.0, 1000.0, "exposure time; turning the camera blurs", most=1000.0,
        logarithmic=True, drawn=False, needs=("neighbours",), of_scene=True,
    ),
}  # fmt: skip
