"""How the IMUs of a recording lie, by gravity in their first samples: no configuration and no odometry is needed for that."""

from collections.abc import Iterator
from itertools import islice
from math import acos

import numpy as np

from ..core.config import Config, ImuSource
from ..core.firewall.rules import RULES
from ..core.inertial import ODD, SIDEWAYS
from ..core.measurement import ImuSample, StaticTransform
from ..core.mounts import Mounts
from ..core.sensors.imu import DECODERS
from ..core.space import SPACES
from .bags import Bag
from .cdr import Decoder
from .inputs import TF_STATIC, BagInputs, Inputs, open_inputs

LOOKED_AT = 200  # samples of each
BASE = "base_link"
GRAVITY = ImuSource().gravity


def sideways(inputs: BagInputs, mounts: Mounts) -> dict[str, float]:
    """Topic -> rad by which the robot would be tilted, of IMUs whose mounting must be another than what is told, or nothing.

    mounts: as far as they are known; /tf_static is read here, and where nothing names the base it is REP 105's.
    """
    found = {}
    mounts.name_base(BASE)
    for bag in inputs.bags:
        static = Decoder(bag.typestore, {TF_STATIC: ("", "static")})
        for record in bag.records({TF_STATIC}) if TF_STATIC in bag.topics else ():
            for item in static.decode(record):
                if isinstance(item, StaticTransform):
                    mounts.add(item)
    for bag in inputs.bags:
        for topic, what in bag.topics.items():
            if what.type in DECODERS and (tilt := _tilt(list(_first(bag, topic)), mounts)) is not None:
                found[topic] = tilt
    return {topic: tilt for topic, tilt in found.items() if tilt > SIDEWAYS}


def leaning(inputs: Inputs, config: Config) -> list[str]:
    """A note for each IMU on its side that a configuration does not use; of one that it uses the run itself says it."""
    if not isinstance(inputs, BagInputs):
        return []
    used = {topic for source in config.sources.values() for topic in source.topics}
    spare = {
        topic for bag in inputs.bags for topic, what in bag.topics.items() if what.type in DECODERS
    } - used
    if not spare:
        return []
    with open_inputs(inputs.paths) as again:  # what a look into them finds damaged is not to be said twice
        assert isinstance(again, BagInputs)
        tilts = sideways(again, Mounts(SPACES["3d"], config.base_frame, config.extrinsics))
    rule = RULES["imu/sideways"]
    return [
        f"{topic} is not used (imu/sideways): {rule.what} (tilted by {tilts[topic]:.1f} rad): {rule.advice}"
        for topic in sorted(spare & tilts.keys())
    ]


def _first(bag: Bag, topic: str) -> Iterator[ImuSample]:
    decoder = Decoder(bag.typestore, {topic: ("imu", "imu")})
    for record in islice(bag.records({topic}), LOOKED_AT):
        for item in decoder.decode(record):
            if isinstance(item, ImuSample) and np.isfinite(item.acceleration).all():
                yield item


def _tilt(samples: list[ImuSample], mounts: Mounts) -> float | None:
    """None where what is measured is nothing like gravity: some drivers take it out."""
    if not samples:
        return None
    up = np.mean([sample.acceleration for sample in samples], axis=0)
    size = float(np.linalg.norm(up))
    if abs(size / GRAVITY - 1) > ODD:
        return None
    mount = mounts.whole(samples[0].frame)
    turned = up if mount is None else mount.rotation().matrix() @ up
    return acos(max(-1.0, min(1.0, float(turned[2]) / size)))
