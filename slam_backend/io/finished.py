"""A run directory, read back: what a run left behind, and what a replay of its inputs believed at any moment."""

import csv
import json
from collections.abc import Collection, Mapping
from functools import cached_property
from io import StringIO
from itertools import takewhile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..core.config import Config, OdometrySource
from ..core.difference import Difference
from ..core.errors import BadConfig, BadFile
from ..core.georeference import Georeference
from ..core.measurement import Array, format_stamp, parse_stamp
from ..core.query import Unknown
from ..core.space import SPACES, Space
from ..core.trajectory import Stamps, States, Trajectory
from .configfile import load_config
from .edits import NAME as EDITS
from .edits import Edits, arrivals, read_edits
from .formats import tum
from .formats.lines import read_bytes, read_text
from .history import NAME as HISTORY
from .history import Recorded
from .inputs import open_inputs
from .linearized import Linearized
from .past import Past, Then
from .replay import WHOLE, Cut, Final, Run, replay, settled_stream
from .rundir import ORIENTATION
from .states import NAME as STATES
from .states import read_states

AGAIN = "replay again"  # what to do about a run that is not whole any more
ALIKE = 1e-6  # m and of quaternions; between replays on different machines
TRIANGLE = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])  # of a matrix, by the numbers of its upper triangle


class _Landmark(NamedTuple):
    """Position (3,), quaternion (4,) or nothing, upper triangle (6,) of the position's covariance."""

    position: Array
    orientation: Array
    triangle: Array


def _landmark(row: list[str], turned: bool) -> _Landmark:
    """turned: whether the file has columns for an orientation; they are empty where a landmark has none."""
    told = np.array([word for word in row[5:9] if word] if turned else [], dtype=np.float64)
    at = 9 if turned else 5
    position, triangle = (np.array(words, dtype=np.float64) for words in (row[2:5], row[at : at + 6]))
    return _Landmark(position.reshape(3), told.reshape(4 if len(told) else 0), triangle.reshape(6))


class FinishedRun:
    """A run directory for `core.query`: each file is read once, when it is first needed.

    BadFile if it is no run directory, or a file of it is missing or damaged.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        if not (path / "summary.json").exists():
            what = (
                "is no run directory: it has no summary.json"
                if path.is_dir()
                else "there is no such directory"
            )
            raise BadFile(f"{path}: {what}; name what `replay --out` wrote")
        try:
            self.summary: dict[str, Any] = json.loads(read_text(path / "summary.json"))
            self._keyframes = int(self.summary["counts"]["keyframes"])
            self._landmarks = int(self.summary["counts"]["landmarks"])
            self._decided = sum(self.summary.get("decisions", {}).values())
        except json.JSONDecodeError as error:
            raise BadFile(
                f"{path / 'summary.json'}:{error.lineno}: is damaged: {error.msg}; {AGAIN}"
            ) from None
        except (KeyError, TypeError, ValueError, AttributeError):
            raise BadFile(
                f"{path / 'summary.json'}: is damaged: it does not count keyframes, landmarks and decisions; {AGAIN}"
            ) from None

    @cached_property
    def config(self) -> Config:
        try:
            return load_config(self.path / "config.yaml")
        except BadConfig as error:
            raise BadFile(str(error)) from None

    @property
    def space(self) -> Space:
        return SPACES[self.config.space]

    @property
    def noise(self) -> OdometrySource:
        """Of the odometry; the defaults where relative poses drove the keyframes."""
        driver = self.config.sources.get(self.config.driver or "")
        return driver if isinstance(driver, OdometrySource) else OdometrySource()

    @cached_property
    def trajectory(self) -> Trajectory:
        found = self._trajectory("trajectory.tum")
        self._counted("trajectory.tum", len(found), self._keyframes)
        begins = self.summary.get("sessions", [])[1:]
        return Trajectory(
            found.stamps, found.sevens, np.array([parse_stamp(b) for b in begins], dtype=np.int64)
        )

    @cached_property
    def odometry(self) -> Trajectory:
        found, known = self._trajectory("odometry.tum"), self.trajectory.stamps
        if found.stamps[0] > known[0] or found.stamps[-1] < known[-1]:
            raise BadFile(
                f"{self.path / 'odometry.tum'}: is damaged: it does not reach from the first keyframe to the last; {AGAIN}"
            )
        return found

    @cached_property
    def online(self) -> Trajectory:
        """What was believed of each keyframe when it was newest."""
        return self._trajectory("online.tum")

    @cached_property
    def history(self) -> Recorded | None:
        """None where nobody watched the run."""
        return Recorded(self.path / HISTORY) if (self.path / HISTORY).exists() else None

    @cached_property
    def decisions(self) -> list[Mapping[str, Any]]:
        """The lines of decisions.jsonl."""
        path = self.path / "decisions.jsonl"
        lines = read_bytes(path).split(b"\n")
        if lines[-1]:
            raise BadFile(f"{path}:{len(lines)}: is damaged: the line does not end; {AGAIN}")
        found: list[Mapping[str, Any]] = []
        for number, line in enumerate(lines[:-1], start=1):
            try:
                found.append(dict(json.loads(line)))
            except (ValueError, TypeError):
                raise BadFile(f"{path}:{number}: is damaged: no JSON object; {AGAIN}") from None
        if (told := sum(line.get("count", 1) for line in found)) < self._decided:
            self._counted(path.name, told, self._decided)
        return found

    @cached_property
    def linearized(self) -> Linearized:
        found = Linearized(self.path / "linearized.npz")
        self._counted("linearized.npz", len(found.indices), self._keyframes)
        return found

    @property
    def indices(self) -> Stamps:
        return self.linearized.indices

    @cached_property
    def states(self) -> States:
        return read_states(self.path / STATES)

    @cached_property
    def earth(self) -> Georeference | None:
        """None of a run without fixes."""
        told = self.summary.get("earth")
        try:
            return None if told is None else Georeference.from_json(told)
        except (KeyError, TypeError, ValueError):
            raise BadFile(
                f"{self.path / 'summary.json'}: is damaged: it does not say how the map lies on the earth; {AGAIN}"
            ) from None

    @property
    def landmarks(self) -> Mapping[str, Array]:
        """Positions (3,) in the map, by name."""
        return {name: row.position for name, row in self._landmark_rows.items()}

    @property
    def orientations(self) -> Mapping[str, Array]:
        """(4,) quaternions of the tags that have one, by name."""
        return {name: row.orientation for name, row in self._landmark_rows.items() if len(row.orientation)}

    @property
    def landmark_covariances(self) -> list[Array]:
        """(3, 3) of each position; NaN where it is not determined."""
        return [row.triangle[TRIANGLE] for row in self._landmark_rows.values()]

    @cached_property
    def _landmark_rows(self) -> Mapping[str, "_Landmark"]:
        path = self.path / "landmarks.csv"
        reader = csv.reader(StringIO(read_text(path), newline=""))
        try:
            turned = ORIENTATION[0] in next(reader)
            found = {row[0]: _landmark(row, turned) for row in reader}
        except (csv.Error, ValueError, IndexError):
            raise BadFile(f"{path}:{reader.line_num}: is damaged: no name and position; {AGAIN}") from None
        self._counted(path.name, len(found), self._landmarks)
        return found

    def covariance(self, index: int) -> Array:
        return self.linearized.covariance(index)

    def decision(self, identifier: str) -> Mapping[str, Any] | None:
        """The last line of decisions.jsonl about it."""
        return next((line for line in reversed(self.decisions) if line.get("id") == identifier), None)

    def past(self, stamp: int) -> Then:
        """By a replay of the run's inputs. BadFile if they are not there, or not those of the run any more."""
        if (earlier := self._earlier(stamp)) is not None:
            return earlier.past(stamp)
        then = self._past.at(stamp)
        self._compare(stamp)
        return then

    def between(self, first: int, last: int) -> Difference:
        """What changed from one stamp to another, found in the same way. BadConfig where the run never was."""
        if last < first:
            raise BadConfig(f"--to {format_stamp(last)} lies before --from {format_stamp(first)}")
        if (earlier := self._earlier(first)) is not None:
            if self._earlier(last) is None:
                raise BadConfig(
                    f"--from {format_stamp(first)} lies in an earlier session than --to; ask {earlier.path}"
                )
            return earlier.between(first, last)
        try:
            found = self._past.between(first, last)
        except Unknown as why:
            raise BadConfig(f"{self.path}: {why}") from None
        self._compare(last)
        return found

    def _earlier(self, stamp: int) -> "FinishedRun | None":
        """The run that this one continues, where the stamp lies before this one's first."""
        breaks = self.trajectory.breaks
        earlier = self._continued
        return FinishedRun(earlier) if earlier is not None and stamp < breaks[-1] else None

    @cached_property
    def edits(self) -> Edits:
        """What was done to it after its end."""
        return read_edits(self.path / EDITS)

    def again(self, edits: Edits | None = None) -> Run:
        """A replay of its inputs to the same end; edits: others than its own. BadFile if they are not there any more."""
        final: Final = "batch" if self.summary.get("batch") else "none"
        done = self.edits if edits is None else edits
        return replay(
            self._inputs, self.config, final=final, edits=done, continued=self._continued, cut=self._cut
        )

    def numbers(self, ids: Collection[str], dropped: Collection[int]) -> dict[str, int]:
        """Which measurements of the inputs, in order of arrival, have these ids in a run without those that are dropped."""
        with open_inputs(self._inputs) as inputs:
            known = takewhile(lambda _: inputs.read <= self._cut.records, inputs.stream(self.config))
            return arrivals(known, self.config, dropped, ids, settled_stream)

    def compare(self, run: Run) -> None:
        """BadFile where a whole replay took another way than the run itself."""
        self._alike(run.online, self.online)

    @cached_property
    def _inputs(self) -> list[Path]:
        estimator = self.summary.get("estimator", "isam2")
        if estimator != "isam2":
            raise BadFile(
                f"{self.path}: what '{estimator}' believed earlier cannot be asked, nor edited; only isam2 can be"
            )
        paths = [Path(path) for path in self.summary["input"]]
        if gone := [path for path in paths if not path.exists()]:
            raise BadFile(
                f"{self.path}: what was believed earlier (or would be after an edit) is found by a replay of its inputs, and {gone[0]} is not there; put it back"
            )
        return paths

    @property
    def _cut(self) -> Cut:
        """Where its inputs ended for it."""
        ended = self.summary.get("ended", "input")
        return WHOLE if ended == "input" else Cut(self.summary["counts"]["records"], ended == "interrupted")

    @property
    def _continued(self) -> Path | None:
        """The run whose map it goes on in."""
        continued = self.summary.get("continued")
        return None if continued is None else Path(continued)

    @cached_property
    def _past(self) -> Past:
        paths, dropped, cut = self._inputs, Edits(self.edits.dropped), self._cut
        return Past(lambda: replay(paths, self.config, edits=dropped, continued=self._continued, cut=cut))

    def _compare(self, stamp: int) -> None:
        """What the replay believed of each keyframe when it was newest with what the run itself did."""
        again = self._past.run_at(stamp).online
        self._alike(again, Trajectory(self.online.stamps[: len(again)], self.online.sevens[: len(again)]))

    def _alike(self, again: Trajectory, first: Trajectory) -> None:
        if len(again) > len(first) and set(first.stamps[:-1].tolist()) < set(again.stamps.tolist()):
            raise BadFile(
                f"{self.path}: its inputs go on after its end: it was saved while they came. Edit the running node (~/edit), "
                "or the run that is saved at the end of the session"
            )
        same = again.stamps.tolist() == first.stamps.tolist()
        if not same or np.abs(again.sevens - first.sevens).max(initial=0.0) > ALIKE:
            names = ", ".join(self.summary["input"])
            raise BadFile(
                f"{self.path}: a replay of {names} takes another way: the inputs have changed, or the versions"
            )

    def _counted(self, name: str, found: int, counted: int) -> None:
        if found != counted:
            raise BadFile(
                f"{self.path / name}: is damaged: it holds {found} where summary.json counts {counted}; {AGAIN}"
            )

    def _trajectory(self, name: str) -> Trajectory:
        found = tum.read(self.path / name)
        if (back := np.flatnonzero(np.diff(found.stamps) <= 0)).size:
            raise BadFile(
                f"{self.path / name}: is damaged: pose {back[0] + 2} is not later than the one before; {AGAIN}"
            )
        sevens = found.sevens.copy()
        sevens[:, 3:] /= np.linalg.norm(sevens[:, 3:], axis=1, keepdims=True)
        return Trajectory(found.stamps, sevens)
