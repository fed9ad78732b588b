"""What a camera does to a ray: sensor_msgs/CameraInfo or the configuration, and pixels freed from distortion.

Distortion as OpenCV and ROS write it (plumb_bob k1 k2 p1 p2 k3, rational_polynomial k1 k2 p1 p2 k3 k4 k5 k6); Brown, 1971.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from ..config import PixelsSource
from ..errors import BadMessage
from ..measurement import Array, Constant, Decoder, Message, parse_frame, stamp_of
from .triangulation import Lens

MODELS = {"plumb_bob": 5, "rational_polynomial": 8}  # name in CameraInfo -> coefficients
ROUNDS = 20  # of the fixed point that frees a pixel from distortion; a usual lens needs five
EXACT = 1e-3  # pixels that distorting anew may differ by: beyond, the model does not hold there


@dataclass(frozen=True, slots=True, eq=False)
class CameraModel(Constant):
    """Of a source. raw: of the image as taken; rectified: of the rectified one, with the baseline where the message is that of
    the right camera. distortion: eight coefficients in OpenCV's order. frame: the optical frame that was told, if any.
    """

    raw: Lens
    distortion: Array
    rectified: Lens
    frame: str = ""

    def is_of(self, frame: str) -> bool:
        """Whether it may be of the camera that sees from a frame. That of a right camera is also of the left one of the pair."""
        return not self.frame or self.frame == frame or self.rectified.baseline > 0


def decode_info(message: Message, source: str) -> CameraModel:
    """sensor_msgs/msg/CameraInfo. BadMessage where it says nothing (not calibrated), or of a model that is not known."""
    k, p, d = (np.asarray(each, dtype=np.float64).ravel() for each in (message.k, message.p, message.d))
    rectified = Lens(p[0], p[5], p[2], p[6], max(-p[3] / p[0], 0.0) if p[0] else 0.0)
    model = message.distortion_model
    if d.any() and model not in MODELS:
        raise BadMessage(f"distortion model '{model}' is not known; known: {', '.join(MODELS)}")
    frame, _ = parse_frame(message.header.frame_id)
    found = CameraModel(stamp_of(message), source, Lens(k[0], k[4], k[2], k[5]), _eight(d), rectified, frame)
    if not any(_usable(lens) for lens in (found.raw, found.rectified)):
        raise BadMessage("the camera is not calibrated: neither its K nor its P has focal lengths")
    return found


DECODERS: Mapping[str, Decoder] = {"sensor_msgs/msg/CameraInfo": decode_info}


def configured(config: PixelsSource, told: CameraModel | None) -> CameraModel | None:
    """What the configuration says, else what a message told; None while nobody has. A configured baseline stands above a told one."""
    given = config.camera
    if given.fx and given.fy and given.cx is not None and given.cy is not None:
        lens = Lens(given.fx, given.fy, given.cx, given.cy, given.baseline or 0.0)
        return CameraModel(0, "", lens, _eight(np.array(given.distortion)), lens)
    if told is None or given.baseline is None:
        return told
    return replace(told, rectified=told.rectified._replace(baseline=given.baseline))


def lens_of(model: CameraModel, config: PixelsSource) -> Lens | None:
    """Through which the pixels of the source are seen once they are free of distortion; None if the model does not say."""
    lens = model.raw if config.image == "raw" else model.rectified
    return lens if _usable(lens) else None


def undistorted(pixels: Array, model: CameraModel) -> tuple[Array, Array]:
    """(N, 2) pixels of the raw image to where a lens without distortion would have put them, NaN where the model does not hold;
    (N,) by what a length there is stretched, in the mean of all directions.
    """
    lens, wanted = model.raw, np.full(pixels.shape, np.nan)
    if not model.distortion.any():
        return pixels, np.ones(len(pixels))
    target = (pixels - [lens.cx, lens.cy]) / [lens.fx, lens.fy]
    point = target.copy()
    with np.errstate(all="ignore"):
        for _ in range(ROUNDS):
            factor, shift = _distortion(point, model.distortion)
            point = (target - shift) / factor[:, None]
        factor, shift = _distortion(point, model.distortion)
        missed = np.abs(point * factor[:, None] + shift - target).max(axis=1) * lens.fx
        good = missed < EXACT
        stretch = 1 / np.sqrt(
            np.abs(np.linalg.det(_of_distortion(np.where(good[:, None], point, 0.0), model)))
        )
    wanted[good] = point[good] * [lens.fx, lens.fy] + [lens.cx, lens.cy]
    return wanted, stretch


def _distortion(point: Array, d: Array) -> tuple[Array, Array]:
    """Radial factor (N,) and tangential shift (N, 2) at (N, 2) normalized points."""
    x, y = point.T
    square = x * x + y * y
    radial = 1 + square * (d[0] + square * (d[1] + square * d[4]))
    radial = radial / (1 + square * (d[5] + square * (d[6] + square * d[7])))
    shift_x = 2 * d[2] * x * y + d[3] * (square + 2 * x * x)
    shift_y = d[2] * (square + 2 * y * y) + 2 * d[3] * x * y
    return radial, np.column_stack([shift_x, shift_y])


def _of_distortion(point: Array, model: CameraModel) -> Array:
    """(N, 2, 2) derivative of the distorted by the undistorted point, by central differences."""
    columns = []
    for axis in range(2):
        step = np.zeros(2)
        step[axis] = 1e-6
        ends = []
        for end in (point + step, point - step):
            factor, shift = _distortion(end, model.distortion)
            ends.append(end * factor[:, None] + shift)
        columns.append((ends[0] - ends[1]) / 2e-6)
    return np.stack(columns, axis=2)


def _usable(lens: Lens) -> bool:
    return bool(np.isfinite(lens).all()) and lens.fx > 0 and lens.fy > 0


def _eight(coefficients: Array) -> Array:
    """Missing ones are zero; BadMessage for more than there are."""
    if len(coefficients) > 8 or not np.isfinite(coefficients).all():
        raise BadMessage(
            f"{len(coefficients)} coefficients of distortion where up to 8 finite ones are known"
        )
    eight = np.zeros(8)
    eight[: len(coefficients)] = coefficients
    eight.setflags(write=False)
    return eight
