"""Robust stages: what judges proposed factors before they enter, and reviews them after.

A stage sees the factors that the solver has not taken yet, with an estimate that already knows the newest
keyframe (motion goes in first), so joint covariances with it exist. What one stage lets in, at `admit` or at `review`, is
judged by the others of the list. One file per strategy; ROBUST is the list of them, KERNELS (in kernels.py) the list of
robust kernels, which act per source. Doubt stands beside the list: wherever there are fixes on the earth, it judges those.
"""

from collections.abc import Callable, Mapping

from ..config import Config, StageName
from .doubt import Doubt
from .gate import Gate
from .gnc import Gnc
from .max_mixture import MaxMixture
from .paths import Paths
from .pcm import Pcm
from .rrr import Rrr
from .stage import Judged, Robust
from .switchable import Switchable
from .witness import Witness

__all__ = ["ROBUST", "Doubt", "Judged", "Paths", "Robust"]

ROBUST: Mapping[StageName, Callable[[Config, Paths], Robust]] = {
    "gate": Gate,
    "witness": Witness,
    "pcm": Pcm,
    "gnc": Gnc,
    "switchable": Switchable,
    "max_mixture": MaxMixture,
    "rrr": Rrr,
}
