"""How the graph is built and solved: keyframes, order, solver, floor, earth, landmarks that move."""

from typing import Literal

from pydantic import Field, field_validator

from .section import Section


class Keyframes(Section):
    """When a pose variable is made: as soon as one of these is reached."""

    distance: float = Field(0.5, gt=0, le=1000, description="metres travelled since the last keyframe")
    angle: float = Field(0.2, gt=0, le=6.3, description="radians turned since the last keyframe")
    time: float | None = Field(
        None, gt=0, description="seconds since the last keyframe; none: never for time alone"
    )
    every: bool = Field(False, description="a keyframe at every message of the driving source")


class Settle(Section):
    """Measurements are put in the order of their stamps before they are used."""

    lag: float = Field(
        0.2, ge=0, le=60, description="seconds that a measurement waits for others with older stamps"
    )
    ahead: float = Field(
        600.0,
        gt=0,
        le=1e9,
        description="seconds by which stamps may be ahead of the driving source; beyond, clocks differ: refused",
    )


class Isam2(Section):
    """Incremental smoothing (Kaess et al., IJRR 2012)."""

    relinearize_threshold: float = Field(
        0.1, gt=0, description="change of a variable (m, rad) that relinearizes it"
    )
    relinearize_skip: int = Field(
        10, ge=1, le=1_000_000, description="updates between two looks at that threshold"
    )
    wildfire_threshold: float = Field(
        1e-4, ge=0, description="change (m, rad) below which an update is not carried on to older variables"
    )
    extra_updates: int = Field(
        2,
        ge=0,
        le=20,
        description="largest number of further updates after a loop, until nothing relinearizes",
    )
    factorization: Literal["auto", "cholesky", "qr"] = Field(
        default="auto", description="auto: Cholesky, and QR for the rest of the run once Cholesky has failed"
    )


class Floor(Section):
    """Where a robot on a floor is in space 3d. Off as it stands: each number that is given adds a prior to every keyframe."""

    z: float | None = Field(None, gt=0, le=1e6, description="m around 0: height of the base in the map")
    tilt: float | None = Field(
        None,
        gt=0,
        le=3.2,
        description="rad by which the base's z leans from the map's, each way (roll and pitch)",
    )


class Coast(Section):
    """Motion where no odometry and no IMU tells it: fixes, or absolute poses, and constant velocity between them."""

    acceleration: float = Field(
        1.0,
        gt=0,
        le=1e6,
        description="m/s^2 in 1 s, white: how far constant velocity is believed; less where a robot is slow and calm",
    )
    turn_rate: float = Field(0.5, gt=0, le=1e6, description="rad/s in 1 s, white: how the robot may turn")
    tilt: float = Field(
        0.2, gt=0, le=3.2, description="rad of roll and pitch, each way (3d), unless floor.tilt says it"
    )
    max_speed: float = Field(
        50.0, gt=0, le=1e4, description="m/s: positions farther apart than that cannot both be right"
    )
    keyframe_time: float = Field(
        1.0, gt=0, le=3600, description="seconds between keyframes at most, as far as there are positions"
    )


class Quarantine(Section):
    """Landmarks that moved or exist twice become two, and those that move are taken out, by the history of their residuals."""

    sightings: int = Field(
        5,
        ge=2,
        le=30,
        description="of the last 30 that do not fit, where other landmarks do, before a landmark is suspected",
    )
    probability: float = Field(
        0.999,
        gt=0,
        lt=1,
        description="with which a sighting fits, if noise is as stated (or as usual, if that is more)",
    )
    split: int = Field(
        5,
        ge=0,
        le=1000,
        description="sightings that each of two places must have for a landmark to become two; with fewer it is taken out; 0: it always is",
    )


class Budget(Section):
    """Bounded cost: what a landmark has been seen from before is summarized; nothing becomes surer by it."""

    sightings: int = Field(
        0,
        ge=0,
        le=1_000_000,
        description="most factors that a landmark keeps; of more, old ones from one keyframe are combined, and then those that say "
        "least go. 0: all stay",
    )


class Earth(Section):
    """Where the map lies on the earth, for sources of kind gnss: estimated, from what is known beforehand."""

    origin: tuple[float, float, float] | None = Field(
        None,
        description="latitude, longitude (degrees, WGS-84) and altitude (m) of the origin of east, north, up; none: the first fix",
    )
    yaw: float | None = Field(
        None,
        ge=-6.3,
        le=6.3,
        description="rad from east to the map's x axis, counter-clockwise; none: found from the path",
    )
    sigma_yaw: float = Field(0.05, gt=0, le=3.2, description="rad, of that yaw where it is given")
    sigma_level: float = Field(
        0.1, gt=0, le=3.2, description="rad by which the map's z may lean from the vertical (3d)"
    )
    baseline: float = Field(
        5.0, gt=0, le=1e6, description="m that the fixes must reach over before a yaw is looked for"
    )
    yaw_within: float = Field(
        0.2,
        gt=0,
        le=1.5,
        description="rad to which two fixes that far apart must tell the yaw before it is looked for",
    )

    @field_validator("origin")
    @classmethod
    def _on_earth(cls, origin: tuple[float, float, float] | None) -> tuple[float, float, float] | None:
        if origin is not None and not (abs(origin[0]) < 90 and abs(origin[1]) <= 180):
            raise ValueError("latitude lies within 90 degrees, longitude within 180")
        return origin
