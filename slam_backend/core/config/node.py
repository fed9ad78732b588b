"""What only the node has: journal and outputs."""

from typing import Literal

from pydantic import Field

from .section import LIVE, Section


class Journaling(Section):
    """The node's journal. A record is acknowledged, and applied, once it has been written and synced to the disk."""

    commit: Literal["group", "full"] = Field(
        default="group",
        description="what shares one sync (fsync) to the disk. group: all records that come within commit_delay; "
        "full: nothing, each record is synced by itself and at once",
    )
    commit_delay: float = Field(
        0.05,
        ge=0,
        le=10,
        description="seconds that a record waits for others to be synced with; what power loss can take at most",
    )
    resume: Literal["unfinished", "always", "never"] = Field(
        default="unfinished",
        description="when a start goes on with the session in data_dir. unfinished: when its process did not end it "
        "(kill, power loss); always: after a regular end, too; never: the journal is set aside",
    )


class PathOutput(Section):
    """The node's ~/path: for eyes; complete trajectories go on ~/trajectory."""

    poses: int = Field(10_000, ge=1, description="newest keyframes in it", json_schema_extra=LIVE)
    rate: float = Field(1.0, gt=0, le=50, description="Hz at most", json_schema_extra=LIVE)
