"""Every fix that was told, used or kept back: what can be said afterwards about a run on the earth."""

from array import array
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .config import GnssSource
from .geometry import inverse_of, matrix_of
from .graph import Pose
from .measurement import SECOND, Array
from .sensors.gnss import Fix, enu, stated
from .trajectory import Snapshot, Stamps


@dataclass(frozen=True, slots=True, eq=False)
class Compared:
    """stamps: (N,) ns, in order of arrival. sources: (N,) names. places: (N, 3) degrees, degrees, m. sigmas: (N, 2) m, horizontal and
    vertical. withheld: (N,) of no part in the estimate. fixes, antennas: (N, 3) m east, north, up, as told and as estimated; the latter NaN
    where no trajectory covers the stamp, or the map has no place on the earth yet.
    """

    stamps: Stamps
    sources: tuple[str, ...]
    places: Array
    sigmas: Array
    withheld: NDArray[np.bool_]
    fixes: Array
    antennas: Array


@dataclass(frozen=True, slots=True)
class Tally:
    """Of one receiver. newest: stamp (ns) of its newest fix; status: of that, as in NavSatStatus."""

    told: int = 0
    withheld: int = 0
    newest: int = 0
    status: int = 0


class Fixes:
    """Kept in columns: a receiver tells ten a second, for days."""

    def __init__(self) -> None:
        self._stamps, self._numbers = array("q"), array("d")
        self._who, self._kinds = array("i"), dict[tuple[str, str], int]()
        self._withheld = array("b")
        self._first: dict[str, int] = {}  # stamp, by source
        self._tallies: dict[str, Tally] = defaultdict(Tally)

    def __len__(self) -> int:
        return len(self._stamps)

    def add(self, fix: Fix, config: GnssSource) -> bool:
        """Whether it is to be used: it is not when the configuration keeps it back as a truth."""
        begin = self._first.setdefault(fix.source, fix.stamp)
        tally = self._tallies[fix.source]
        since = (fix.stamp - begin) / SECOND
        every = config.withhold_every
        withheld = any(start <= since < end for start, end in config.withhold)
        withheld |= every is not None and (tally.told + 1) % every == 0
        newest, status = max((tally.newest, tally.status), (fix.stamp, fix.status))
        self._tallies[fix.source] = Tally(tally.told + 1, tally.withheld + withheld, newest, status)
        x, y, z = stated(fix, config).diagonal().tolist()
        self._stamps.append(fix.stamp)
        self._numbers.extend((*fix.place.tolist(), ((x + y) / 2) ** 0.5, z**0.5))
        self._who.append(self._kinds.setdefault((fix.source, fix.frame), len(self._kinds)))
        self._withheld.append(withheld)
        return not withheld

    def tally(self, source: str) -> Tally:
        return self._tallies.get(source, Tally())

    def compared(
        self,
        snapshot: Snapshot,
        map_T_earth: Array | None,
        origin: Sequence[float],
        mount: Callable[[str], Pose | None],
    ) -> Compared:
        """With where the antenna is believed to have been. map_T_earth: (7,). mount: frame -> base_T_frame in 3-D."""
        stamps, numbers = np.array(self._stamps, dtype=np.int64), np.array(self._numbers).reshape(-1, 5)
        who, kinds = np.array(self._who, dtype=np.int64), list(self._kinds)
        antennas = np.full((len(stamps), 3), np.nan)
        if map_T_earth is not None and len(stamps):
            poses = matrix_of(snapshot.at(stamps))
            mounts = [mount(frame) for _, frame in kinds]
            arms = np.array([np.full(3, np.nan) if each is None else each.translation() for each in mounts])
            in_map = (poses[:, :3, :3] @ arms[who][:, :, None])[:, :, 0] + poses[:, :3, 3]
            earth_T_map = inverse_of(matrix_of(map_T_earth))
            antennas = in_map @ earth_T_map[:3, :3].T + earth_T_map[:3, 3]
        return Compared(
            stamps, tuple(kinds[n][0] for n in who.tolist()), numbers[:, :3], numbers[:, 3:],
            np.array(self._withheld, dtype=np.bool_), enu(numbers[:, :3], origin), antennas,
        )  # fmt: skip
