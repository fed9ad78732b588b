"""How a run went: every update, the map as it was believed at some of them, and what each loop did (history.npz).

stamps, ms, factors, keyframes, memory   (U,) of each update: ns, ms, in the graph, in the graph, MB
frame_stamps, frame_sizes                (K,) moments of the run, and how many points the map had then
frame_points, frame_at                   (P, 3) m, the maps one after the other, at most FRAME_POINTS keyframes each; (P,) their ns
loop_ids, loop_stamps                    (L,) of each loop that came in or went out, and the keyframe with which it did
loop_newest, loop_largest, loop_turn     (L,) m, m, rad: how far the newest and the farthest-moved pose went, and how it turned
"""

import resource
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from ..core.backend import Update
from ..core.errors import BadFile
from ..core.geometry import inverse_of, matrix_of
from ..core.graph import Keyframe
from ..core.measurement import Array
from ..core.trajectory import Stamps
from .replay import Run

NAME = "history.npz"
FRAMES = 60  # at most twice as many are kept
FRAME_POINTS = 300
PROBES = 64  # keyframes that are looked at before and after a loop
ARRAYS = {
    "stamps": "i", "ms": "f", "factors": "i", "keyframes": "i", "memory": "f",
    "frame_stamps": "i", "frame_sizes": "i", "frame_points": "f", "frame_at": "i",
    "loop_ids": "U", "loop_stamps": "i", "loop_newest": "f", "loop_largest": "f", "loop_turn": "f",
}  # fmt: skip


class History:
    """Watches a run from outside: `see` each update as it comes."""

    def __init__(self, run: Run) -> None:
        self._run = run
        self._updates: list[tuple[int, float, int, int, float]] = []
        self._frames: list[tuple[int, list[int], Array]] = []
        self._every = 1  # updates between two frames
        self._loops: list[tuple[str, int, float, float, float]] = []
        self._probes: dict[int, Array] = {}  # pose key -> where it was
        self._correction: Array | None = None

    def see(self, update: Update) -> None:
        backend = self._run.backend
        memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        stamp, sizes = update.keyframe.stamp, (len(backend.solver.factors), len(backend.timeline))
        self._updates.append((stamp, self._run.seconds.last_ms, *sizes, memory))
        changed = [
            d.id for d in update.decisions if d.ends and d.verdict in ("accepted", "restored", "removed")
        ]
        if changed:
            newest, turn = self._moved(update)
            largest = max(newest, self._farthest())
            self._loops += [(each, stamp, newest, largest, turn) for each in changed]
            self._probes = self._positions(_spread(backend.timeline.keyframes, PROBES))
        self._correction = np.array(update.correction)
        if len(self._updates) % self._every == 0:
            self._frame(stamp)

    def write(self, path: Path) -> None:
        """Once the run has ended."""
        loops = list(zip(*self._loops, strict=True)) or [(), (), (), (), ()]
        updates = list(zip(*self._updates, strict=True)) or [(), (), (), (), ()]
        columns = (
            *updates,
            [stamp for stamp, _, _ in self._frames],
            [len(at) for _, at, _ in self._frames],
            np.concatenate([np.zeros((0, 3)), *(points for _, _, points in self._frames)]),
            [stamp for _, at, _ in self._frames for stamp in at],
            *loops,
        )
        types = {"i": np.int64, "f": np.float32, "U": np.str_}
        np.savez_compressed(
            path,
            allow_pickle=False,
            **{
                name: np.array(c, dtype=types[k])
                for (name, k), c in zip(ARRAYS.items(), columns, strict=True)
            },
        )

    def _moved(self, update: Update) -> tuple[float, float]:
        """How far (m, rad) the newest pose lies from where the last correction had put it."""
        if self._correction is None:
            return 0.0, 0.0
        now, before = matrix_of(np.array(update.correction)), matrix_of(self._correction)
        pose = matrix_of(np.array(update.pose))
        step = inverse_of(before @ inverse_of(now) @ pose) @ pose
        cosine = (np.trace(step[:3, :3]) - 1) / 2
        return float(np.linalg.norm(step[:3, 3])), float(np.arccos(np.clip(cosine, -1, 1)))

    def _farthest(self) -> float:
        now = self._positions_of(self._probes)
        return max((float(np.linalg.norm(now[key] - was)) for key, was in self._probes.items()), default=0.0)

    def _frame(self, stamp: int) -> None:
        """The map as it is now; every second one is forgotten when there are too many."""
        keyframes = sorted(_spread(self._run.backend.timeline.keyframes, FRAME_POINTS), key=lambda k: k.stamp)
        points = np.array(list(self._positions(keyframes).values())).reshape(-1, 3)
        self._frames.append((stamp, [keyframe.stamp for keyframe in keyframes], points))
        if len(self._frames) >= 2 * FRAMES:
            self._frames = self._frames[1::2]
            self._every *= 2

    def _positions(self, keyframes: list[Keyframe]) -> dict[int, Array]:
        return self._positions_of({keyframe.pose: None for keyframe in keyframes})

    def _positions_of(self, keys: Mapping[int, object]) -> dict[int, Array]:
        estimate, found = self._run.backend.estimate, {}
        for key in keys:
            found[key] = np.zeros(3)
            place = estimate.pose(key).translation()
            found[key][: len(place)] = place
        return found


class Recorded:
    """A history.npz. BadFile if it is damaged."""

    def __init__(self, path: Path) -> None:
        try:
            with np.load(path) as file:
                arrays = {name: file[name] for name in ARRAYS}
        except OSError as error:
            raise BadFile(f"{path}: cannot be read: {error.strerror or error}; replay again") from None
        except (TypeError, ValueError, KeyError, EOFError, BadZipFile, zlib.error) as error:
            raise BadFile(f"{path}: is damaged: {str(error).splitlines()[0]}; replay again") from None
        lengths = [len(arrays[name]) for name in ARRAYS]
        groups = lengths[:5], lengths[5:7], [*lengths[7:9], arrays["frame_sizes"].sum()], lengths[9:]
        if any(len(set(group)) != 1 for group in groups):
            raise BadFile(f"{path}: is damaged: its arrays do not fit together; replay again")
        self._arrays = arrays

    def __getitem__(self, name: str) -> NDArray[Any]:
        """One of ARRAYS."""
        return np.asarray(self._arrays[name])

    @property
    def frames(self) -> list[tuple[Stamps, Array]]:
        """The maps at frame_stamps: (n,) stamps of keyframes, and (n, 3) where they were."""
        ends = np.cumsum(self._arrays["frame_sizes"])[:-1]
        each = (np.split(self._arrays[name], ends) for name in ("frame_at", "frame_points"))
        return list(zip(*each, strict=True)) if len(self._arrays["frame_sizes"]) else []


def _spread(keyframes: list[Keyframe], most: int) -> list[Keyframe]:
    """At most so many, evenly, the last one among them."""
    step = -(-len(keyframes) // most)
    return keyframes[::-1][:: max(step, 1)][::-1]
