"""What a snapshot tells of itself, for queries of a run that is not finished."""

from collections.abc import Mapping
from functools import cached_property

from .config import Config, OdometrySource
from .georeference import Georeference
from .measurement import Array
from .space import SPACES
from .trajectory import Snapshot, Stamps, States, Trajectory


class Shown:
    """The part of core.query.Known that needs nobody else."""

    def __init__(self, snapshot: Snapshot, config: Config) -> None:
        self.snapshot = snapshot
        self.space = SPACES[config.space]
        driver = config.sources.get(config.driver or "")
        self.noise = driver if isinstance(driver, OdometrySource) else OdometrySource()

    @property
    def trajectory(self) -> Trajectory:
        return self.snapshot.trajectory

    @property
    def indices(self) -> Stamps:
        return self.snapshot.indices

    @property
    def odometry(self) -> Trajectory:
        return self.snapshot.odometry

    @property
    def states(self) -> States:
        return self.snapshot.states

    @property
    def earth(self) -> Georeference | None:
        return self.snapshot.earth

    @cached_property
    def landmarks(self) -> Mapping[str, Array]:
        return dict(zip(self.snapshot.names, self.snapshot.landmarks, strict=True))

    @property
    def orientations(self) -> Mapping[str, Array]:
        return self.snapshot.orientations
