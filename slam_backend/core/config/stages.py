"""What judges loops before they enter the graph."""

from typing import Literal

from pydantic import Field

from .section import Section

StageName = Literal["gate", "witness", "pcm", "gnc", "switchable", "max_mixture", "rrr"]


class Gate(Section):
    """Refuses a loop that contradicts the cheapest path between its ends, through odometry and accepted loops."""

    odometry_scale: float = Field(
        10.0,
        gt=0,
        le=10_000,
        description="what the odometry's covariance is multiplied by: stated noise leaves out bias and correlation in time",
    )
    probability: float = Field(
        0.999, gt=0, lt=1, description="with which a true loop passes, if all noise is as stated and scaled"
    )
    drift: float = Field(
        0.1,
        gt=0,
        le=10,
        description="m of drift per m of path that odometry never exceeds, whatever its covariance; twice that, in rad, of heading",
    )


class Witness(Section):
    """Keeps a far loop on probation until others agree with it over short odometry (PCM: Mangelson et al., ICRA 2018)."""

    others: int = Field(
        2, ge=1, le=20, description="loops that must agree with a far one, and with each other"
    )
    near: float = Field(
        2.0,
        ge=0,
        le=1e6,
        description="m: a loop needs no witness where odometry and accepted loops already say to within this where it ends",
    )
    reach: float = Field(
        50.0, gt=0, le=1e6, description="m of odometry, both ends together, over which two loops are compared"
    )
    apart: float = Field(
        1.0,
        ge=0,
        le=1e6,
        description="m of odometry, both ends together, below which two loops are the same evidence",
    )
    lone: float = Field(
        0.0,
        ge=0,
        lt=1,
        description="a far loop enters without witnesses if it lies within this probability of where it is expected; 0: never",
    )
    held: int = Field(
        2000, ge=1, le=1_000_000, description="loops kept on probation; the oldest of more is refused"
    )


class Pcm(Section):
    """Pairwise consistency maximization: the largest set of loops that agree (Mangelson et al., ICRA 2018)."""

    probability: float = Field(
        0.99, gt=0, lt=1, description="with which two true loops agree, if all noise is as stated and scaled"
    )
    smallest: int = Field(2, ge=1, le=100, description="loops that the set must have at least")
    steps: int = Field(
        20_000,
        ge=1,
        le=100_000_000,
        description="loops looked at in the search for one new loop; beyond, it is not exact",
    )


class Gnc(Section):
    """Graduated non-convexity, aside (Yang et al., RA-L 2020)."""

    every: int = Field(200, ge=1, le=1_000_000, description="keyframes from one judgment to the next")
    lag: int = Field(
        50, ge=1, le=1_000_000, description="keyframes from the begin of a judgment to its landing"
    )


class Switchable(Section):
    """Switchable constraints in closed form (Sünderhauf & Protzel, IROS 2012; Agarwal et al., ICRA 2013)."""

    phi: float = Field(
        1.0,
        gt=0,
        le=1e6,
        description="what it costs to switch a loop off; a chi-square up to this is left alone by dcs",
    )
    form: Literal["dcs", "exact"] = Field(
        default="dcs", description="dcs: dynamic covariance scaling; exact: the quadratic prior of the paper"
    )


class MaxMixture(Section):
    """Each loop as it is or a null hypothesis, whichever is likelier (Olson & Agarwal, IJRR 2013)."""

    weight: float = Field(0.01, gt=0, lt=1, description="of the null hypothesis")
    scale: float = Field(1e-12, gt=0, lt=1, description="of the information, in the null hypothesis")


class Rrr(Section):
    """Clusters of loops that agree within and between, aside (Latif et al., IJRR 2013)."""

    gap: float = Field(
        10.0, ge=0, le=1e6, description="m of odometry between neighbours in a cluster, at each end"
    )
    every: int = Field(500, ge=1, le=1_000_000, description="keyframes from one judgment to the next")
    lag: int = Field(
        50, ge=1, le=1_000_000, description="keyframes from the begin of a judgment to its landing"
    )
