"""How far iSAM2's last estimate is from the optimum of the same factors, which `--final batch` gives."""

from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from bench.overhead import DATA
from bench.park import CONFIG
from bench.table import Row
from slam_backend.core.geometry import inverse_of, matrix_of, quaternion_of
from slam_backend.core.measurement import Array
from slam_backend.io.configfile import load_config
from slam_backend.io.replay import replay
from slam_backend.lab.datasets import make_dataset

TITLE = "Online against the optimum"
EXPLANATION = (
    "Largest difference of a pose between iSAM2's last estimate and a batch solve of the same factors (`--final batch`: "
    "Gauss-Newton until the step is below 1e-9), and what is left of it when everything is linearized anew at the end of a replay."
)
# file, bounds in m and rad
GRAPHS = {
    "intel": ("pgo_sesync/intel.g2o", "<= 0.02", "<= 0.005"),
    "M3500": ("pgo_carlone2d/M3500.g2o", "<= 0.15", "<= 0.01"),
    "parking-garage": ("pgo_sesync/parking-garage.g2o", "<= 0.15", "<= 0.01"),
}


def rows() -> list[Row]:
    found: list[Row] = []
    for name, (file, meters, radians) in GRAPHS.items():
        if (DATA / file).exists():
            found += _rows(name, DATA / file, None, meters, radians)
    with TemporaryDirectory() as folder:
        bag = Path(folder) / "park.mcap"
        make_dataset("victoria_park", bag, lambda _: None)
        found += _rows("Victoria Park", bag, CONFIG, "<= 0.02", "<= 0.005")
    return found


def _rows(name: str, path: Path, config: Path | None, meters: str, radians: str) -> Iterator[Row]:
    run = replay(path, load_config(config) if config else None, final="batch")
    seen: list[Array] = []
    polish = run.backend.polish

    def watched() -> None:
        seen.append(run.backend.snapshot().trajectory.sevens)
        polish()
        seen.append(run.backend.snapshot().trajectory.sevens)

    run.backend.polish = watched  # type: ignore[method-assign]
    optimum = run.result.trajectory.sevens
    online, polished = (difference(each, optimum) for each in seen)
    yield Row(f"{name}: position", f"{online[0]:.4f} m", f"{polished[0]:.1e} m polished", online[0], meters)
    yield Row(
        f"{name}: rotation", f"{online[1]:.5f} rad", f"{polished[1]:.1e} rad polished", online[1], radians
    )


def difference(a: Array, b: Array) -> tuple[float, float]:
    """Largest distance (m) and angle (rad) between two (N, 7) trajectories."""
    apart = inverse_of(matrix_of(a)) @ matrix_of(b)
    sines = np.linalg.norm(quaternion_of(apart[:, :3, :3])[:, :3], axis=1)
    return float(np.linalg.norm(apart[:, :3, 3], axis=1).max()), float(
        2 * np.arcsin(np.clip(sines, 0, 1)).max()
    )
