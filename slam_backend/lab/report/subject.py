"""What a page is about: a run, and what it is compared with."""

from collections.abc import Mapping
from pathlib import Path

from ...core.trajectory import Trajectory
from ...io.finished import FinishedRun


class Subject(FinishedRun):
    """truth: laid over the run's frame. beside: what others believed at the time (a filter, another setting), by name."""

    def __init__(
        self, path: Path, truth: Trajectory | None = None, beside: Mapping[str, Trajectory] | None = None
    ) -> None:
        super().__init__(path)
        self.truth, self.beside = truth, dict(beside or {})
