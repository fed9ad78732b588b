"""Every setting, once: type, default, range, unit and a sentence. YAML, `--help` and docs are derived from here.

In YAML the sources are named in a list and described at the top level, so that the same file serves the node:

    space: 2d
    sources: [wheels, trees]
    wheels: {kind: odometry, topic: /odom}
    trees: {kind: landmark, topic: /trees, kernel: cauchy}
"""

from .estimation import Budget, Coast, Earth, Floor, Isam2, Keyframes, Quarantine, Settle
from .node import Journaling, PathOutput
from .reading import config_from, config_hash, config_to, words_of
from .section import LIVE, Section
from .sources import (
    IMU_PRESETS,
    AnySource,
    Camera,
    GnssSource,
    ImuNoise,
    ImuSource,
    KernelName,
    LandmarkSource,
    Mounted,
    Observing,
    OdometrySource,
    PixelsSource,
    PoseSource,
    RelativeSource,
    Source,
)
from .stages import Gate, Gnc, MaxMixture, Pcm, Rrr, StageName, Switchable, Witness
from .whole import Config

__all__ = [
    "IMU_PRESETS",
    "LIVE",
    "AnySource",
    "Budget",
    "Camera",
    "Coast",
    "Config",
    "Earth",
    "Floor",
    "Gate",
    "Gnc",
    "GnssSource",
    "ImuNoise",
    "ImuSource",
    "Isam2",
    "Journaling",
    "KernelName",
    "Keyframes",
    "LandmarkSource",
    "MaxMixture",
    "Mounted",
    "Observing",
    "OdometrySource",
    "PathOutput",
    "Pcm",
    "PixelsSource",
    "PoseSource",
    "Quarantine",
    "RelativeSource",
    "Rrr",
    "Section",
    "Settle",
    "Source",
    "StageName",
    "Switchable",
    "Witness",
    "config_from",
    "config_hash",
    "config_to",
    "words_of",
]
