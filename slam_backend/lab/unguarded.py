"""What the map would be without anybody who judges: the same factors, and every loop that was offered."""

from ..core.errors import SlamError
from ..core.solvers.batch import solve
from ..core.solvers.descent import Options
from ..core.trajectory import Trajectory
from ..io.result import Result

ENOUGH = Options(iterations=20, relative=1e-3)  # a warped map need not be warped to the last digit
NAME = "unguarded.tum"


def unguarded(result: Result) -> Trajectory | None:
    """None where no loop was left out, or where all of them together cannot be solved."""
    backend = result.run.backend
    out = [factor for factor in backend.left_out if factor.kind == "loop"]
    if not out:
        return None
    try:
        values = solve([*result.factors, *out], result.values, ENOUGH).values
    except SlamError:
        return None
    keys = [keyframe.pose for keyframe in backend.timeline.in_order()]
    return Trajectory(result.trajectory.stamps, backend.space.sevens(values, keys))
