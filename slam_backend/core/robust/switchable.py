"""Switchable constraints: a switch s in [0, 1] per loop, estimated with the poses (Sünderhauf & Protzel, IROS 2012).

    minimize over poses and switches   sum of s^2 chi2 + P(s)

gtsam has no native factor with a switch. But each switch meets one loop alone, so it can be minimized in closed form and
what remains is a kernel on chi2, with the switch as its by-product:

    P(s) = phi (1 - s)^2         Sünderhauf's prior: s = phi / (phi + chi2), the kernel of Geman & McClure
    P(s) = phi (1 - s) (3 - s)   s = min(1, 2 phi / (phi + chi2)): dynamic covariance scaling (Agarwal et al., ICRA 2013)

The second leaves a loop within phi untouched, where the first weakens every loop that is not met exactly; it is the default.
"""

from functools import partial
from typing import Any

import gtsam

from ..config import Config
from .paths import Paths
from .soft import Soft


class Switchable(Soft):
    def __init__(self, config: Config, paths: Paths) -> None:
        phi, scaled = config.switchable.phi, config.switchable.form == "dcs"
        switch = switch_scaled if scaled else switch_exact
        super().__init__("switchable", paths, kernel_of(phi, scaled), partial(switch, phi))


def kernel_of(phi: float, scaled: bool) -> Any:
    m = gtsam.noiseModel.mEstimator
    return m.DCS.Create(phi) if scaled else m.GemanMcClure.Create(phi**0.5)


def switch_exact(phi: float, chi2: float) -> float:
    return phi / (phi + chi2)


def switch_scaled(phi: float, chi2: float) -> float:
    return min(1.0, 2 * phi / (phi + chi2))
