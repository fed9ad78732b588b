"""Features tracked through the images of a camera, mono or stereo: pixels with ids become reprojection factors.

Frames count where they are a keyframe: a keyframe that is due is made at the newest frame. Between keyframes a frame would share
the error of one motion among all its pixels, which would be counted as if each had its own.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..config import PixelsSource
from ..context import Context, Unusable
from ..errors import BadMessage
from ..firewall.rules import decided
from ..graph import Decision, Delta, Keyframe, Offer
from ..measurement import Array, Decoder, Measurement, Message, frozen, parse_frame, stamp_of
from .camera import DECODERS as INFO
from .camera import configured, lens_of, undistorted
from .cloud import columns, scalars
from .frames import Frame
from .tracks import Tracker

STAGE = "pixels"
LARGEST, SHARPEST = 1e6, 1e-4  # pixels; of no image, and of no way to find features


@dataclass(frozen=True, slots=True, eq=False)
class PixelFrame(Measurement):
    """What one image shows, seen from `frame` (the optical frame: z ahead, x right, y down).

    ids: (N,) of the tracks, -1 for one that is no whole number. pixels: (N, 3) u, v, and u in the right image (NaN: not seen
    there). sigmas: (N,) pixels, NaN: use the configured one.
    """

    frame: str
    ids: NDArray[np.int64]
    pixels: Array
    sigmas: Array


def decode(message: Message, source: str) -> PixelFrame:
    """sensor_msgs/msg/PointCloud2 with the fields `id u v`, and `ur` and `sigma` if there are any."""
    table = columns(message)
    if missing := [name for name in ("id", "u", "v") if name not in table]:
        raise BadMessage(f"point cloud of pixels lacks the field '{missing[0]}'")
    nothing = np.full(len(table["id"]), np.nan)
    table = {"ur": nothing, "sigma": nothing, **table}
    numbers = scalars(table, ("u", "v", "ur", "sigma"))
    frame, _ = parse_frame(message.header.frame_id)
    ids = _whole(scalars(table, ("id",))[:, 0])
    return PixelFrame(stamp_of(message), source, frame, ids, frozen(numbers[:, :3]), frozen(numbers[:, 3]))


def _whole(ids: Array) -> NDArray[np.int64]:
    good = (np.abs(ids) < 2.0**53) & (ids >= 0) & (ids == np.floor(ids))
    return np.where(good, ids, -1).astype(np.int64)


DECODERS: Mapping[str, Decoder] = {"sensor_msgs/msg/PointCloud2": decode, **INFO}


def factors(
    window: Sequence[Offer],
    a: Keyframe | None,  # noqa: ARG001
    b: Keyframe,
    context: Context,
    config: PixelsSource,
) -> Delta:
    """What the frames at keyframes say of tracks; see `tracks.Tracker`."""
    delta = Delta()
    for offer in window:
        m = offer.measurement
        assert isinstance(m, PixelFrame)
        tracker: Tracker = context.memory.setdefault(m.source, Tracker(m.source, config))
        try:
            frame, refused = _frame(offer, m, context, config)
        except Unusable as why:
            delta += Delta(decisions=(_refused(offer, why.reason, why.detail),))
            continue
        delta += Delta(decisions=(*_strange(offer, m, context, config, tracker), *refused)) + tracker.take(
            frame, context, newest=frame.key == b.pose
        )
    return delta


def _frame(
    offer: Offer, m: PixelFrame, context: Context, config: PixelsSource
) -> tuple[Frame, tuple[Decision, ...]]:
    """The frame as the tracker takes it, free of distortion and of what cannot be; why some of it was left out."""
    placed, mount = context.landing(m.stamp), context.mount(m.frame)
    if placed.motion is not None:
        raise Unusable("off_keyframe", "a frame between two keyframes; 'keyframe: true' makes one at each")
    model = configured(config, context.cameras.get(m.source))
    lens = None if model is None else lens_of(model, config)
    if model is None or lens is None:
        raise Unusable("no_camera", "no calibration: set 'camera', or 'info_topic' to that of its CameraInfo")
    pixels, sigmas = m.pixels.copy(), np.where(np.isnan(m.sigmas), config.sigma, m.sigmas)
    stereo = np.isfinite(pixels[:, 2])
    if stereo.any() and not lens.baseline:
        raise Unusable(
            "no_baseline",
            "stereo pixels without a baseline: set 'camera.baseline', or use the right camera's info",
        )
    if config.image == "raw":
        if stereo.any():
            raise Unusable("raw_stereo", "'ur' needs rectified images: set image: rectified")
        pixels[:, :2], stretch = undistorted(pixels[:, :2], model)
        sigmas = sigmas * stretch
    _, first = np.unique(m.ids, return_index=True)
    once = np.zeros(len(m.ids), dtype=np.bool_)
    once[first] = True
    said = {
        "id": (m.ids >= 0, "no whole number"),
        "not_finite": (
            np.isfinite(pixels[:, :2]).all(axis=1) & (sigmas > 0) & np.isfinite(sigmas),
            "pixel or sigma",
        ),
        "absurd": (
            ~(np.abs(pixels) > LARGEST).any(axis=1) & ~(sigmas < SHARPEST) & ~(sigmas > LARGEST),
            f"a pixel beyond {LARGEST:g}, or a sigma below {SHARPEST:g}",
        ),
        "behind": (~stereo | (pixels[:, 0] > pixels[:, 2]), "further right in the right image"),
        "twice": (once, "the id is there already"),
    }
    good = np.ones(len(m.ids), dtype=np.bool_)
    decisions = []
    for reason, (fine, detail) in said.items():
        if wrong := int((good & ~fine).sum()):
            decisions.append(_refused(offer, reason, detail, wrong))
        good &= fine
    frame = Frame(
        offer.id, m.stamp, placed.keyframe.pose, mount, lens, m.ids[good], pixels[good], sigmas[good]
    )
    return frame, tuple(decisions)


def _strange(
    offer: Offer, m: PixelFrame, context: Context, config: PixelsSource, tracker: Tracker
) -> tuple[Decision, ...]:
    """Once for each frame: the calibration is another camera's. The pixels are used all the same: frames are named freely."""
    model = configured(config, context.cameras.get(m.source))
    if model is None or model.is_of(m.frame) or m.frame in tracker.strange:
        return ()
    tracker.strange.add(m.frame)
    detail = f"seen from '{m.frame}', with the calibration of '{model.frame}'"
    return (replace(decided(m, "accepted", "pixels/other_camera"), id=offer.id, detail=detail),)


def _refused(offer: Offer, reason: str, detail: str, count: int = 1) -> Decision:
    m: Any = offer.measurement
    return Decision(m.stamp, offer.id, m.source, "refused", STAGE, reason, detail, count=count)
