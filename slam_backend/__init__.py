"""SLAM back-end: a GTSAM factor-graph smoother as a ROS 2 service, a replay tool, and a library.

import slam_backend as sb
run = sb.replay("drive.mcap", sb.load_config("config/outdoor.yaml"))
for update in run:
...
run.result.trajectory.poses     # (N, 4, 4)
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .core.backend import Backend, Update
    from .core.config import Config
    from .core.errors import BadConfig, BadFile, BadMessage, MissingExtra, SlamError, SolverFailure
    from .core.trajectory import Snapshot, Trajectory
    from .io.configfile import load_config
    from .io.replay import Run, replay
    from .io.result import Result
    from .io.rundir import write_run

_WHERE = {
    "Backend": "core.backend", "Update": "core.backend", "Config": "core.config",
    "BadConfig": "core.errors", "BadFile": "core.errors", "BadMessage": "core.errors",
    "MissingExtra": "core.errors", "SlamError": "core.errors", "SolverFailure": "core.errors",
    "Snapshot": "core.trajectory", "Trajectory": "core.trajectory", "load_config": "io.configfile",
    "Result": "io.result", "Run": "io.replay", "replay": "io.replay", "write_run": "io.rundir",
}  # fmt: skip

__all__ = [
    "Backend", "BadConfig", "BadFile", "BadMessage", "Config", "MissingExtra", "Result", "Run", "SlamError", "Snapshot",
    "SolverFailure", "Trajectory", "Update", "load_config", "replay", "write_run",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    """Import on first use: the command line's --help must not wait for gtsam."""
    if name not in _WHERE:
        raise AttributeError(f"module 'slam_backend' has no attribute '{name}'")
    return getattr(import_module(f".{_WHERE[name]}", __name__), name)
