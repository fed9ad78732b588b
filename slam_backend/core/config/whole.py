"""The whole configuration, and what its parts must agree on."""

from collections.abc import Mapping
from typing import Literal

from pydantic import Field, model_validator

from .estimation import Budget, Coast, Earth, Floor, Isam2, Keyframes, Quarantine, Settle
from .node import Journaling, PathOutput
from .section import Section
from .sources import AnySource
from .stages import Gate, Gnc, MaxMixture, Pcm, Rrr, StageName, Switchable, Witness


class Config(Section):
    """The whole configuration; `Config()` works for one odometry topic and standard loop closures."""

    space: Literal["2d", "3d"] = Field("3d", description="2d: x, y and yaw are estimated; 3d: all six")
    base_frame: str = Field("", description="name of the robot's frame; empty: that of the driving source")
    keyframes: Keyframes = Keyframes()
    settle: Settle = Settle()
    isam2: Isam2 = Isam2()
    gate: Gate = Gate()
    witness: Witness = Witness()
    pcm: Pcm = Pcm()
    gnc: Gnc = Gnc()
    switchable: Switchable = Switchable()
    max_mixture: MaxMixture = MaxMixture()
    rrr: Rrr = Rrr()
    robust: tuple[StageName, ...] = Field(
        ("gate", "witness"),
        description="what judges loops before they enter the graph, in this order; empty: nothing does",
    )
    map_frame: str = Field(
        "map", description="name of the frame of the optimized trajectory, in what the node publishes"
    )
    odom_frame: str = Field("odom", description="name of the odometry's frame, in what the node publishes")
    data_dir: str = Field(
        "", description="where the node keeps its journal and saved runs; empty: ~/.ros/slam_backend/<node>"
    )
    autostart: bool = Field(default=True, description="the node configures and activates itself")
    on_clock_jump: Literal["reset", "ignore"] = Field(
        default="ignore",
        description="when stamps of the driving source jump back (a looped bag): start anew, or refuse them",
    )
    journal: Journaling = Journaling()
    floor: Floor = Floor()
    coast: Coast = Coast()
    quarantine: Quarantine = Quarantine()
    budget: Budget = Budget()
    path: PathOutput = PathOutput()
    earth: Earth = Earth()
    extrinsics: Mapping[str, tuple[float, float, float, float, float, float]] = Field(
        default_factory=dict,
        description="frame: x, y, z (m), roll, pitch, yaw (rad) of that sensor in the base",
    )
    sources: Mapping[str, AnySource] = Field(
        default_factory=dict, description="the inputs by name; empty: found by the types of the topics"
    )

    @model_validator(mode="after")
    def _something_drives(self) -> "Config":
        for name in self.sources:
            if not name or "/" in name or "@" in name:
                raise ValueError(f"source name '{name}' must not be empty or contain '/' or '@'")
            if name in Config.model_fields or name in ("gauge", "datum", "command", "floor"):
                raise ValueError(f"a source cannot be called '{name}': that name has a meaning of its own")
        if len(set(self.robust)) < len(self.robust):
            raise ValueError(f"'robust' names '{max(self.robust, key=self.robust.count)}' twice")
        if self.space == "2d" and (self.floor.z or self.floor.tilt):
            raise ValueError("'floor' needs space: 3d; in 2d nothing leaves the plane")
        flat = [
            name for name, source in self.sources.items() if self.space == "2d" and source.kind == "pixels"
        ]
        if flat:
            raise ValueError(
                f"source '{flat[0]}': pixels need space 3d: where a feature is seen depends on height, roll and pitch"
            )
        if self.sources and self.driver is None:
            raise ValueError(
                "no source drives the keyframes: add one of kind odometry, imu, relative, gnss or pose"
            )
        imus = [name for name, source in self.sources.items() if source.kind == "imu"]
        if imus and self.space == "2d":
            raise ValueError(
                f"source '{imus[0]}': an IMU needs space: 3d, since in a plane nothing tells how gravity lies; "
                "a robot on a floor takes 3d, too"
            )
        if imus[1:]:
            raise ValueError(f"source '{imus[1]}': a second IMU; '{imus[0]}' is the one that is used")
        return self

    @property
    def driver(self) -> str | None:
        """The source that drives the keyframes: the first odometry, else the IMU, else the first relative; where none of these
        tells motion, the first GNSS, else the first absolute pose.
        """
        for kind in ("odometry", "imu", "relative", "gnss", "pose"):
            for name, source in self.sources.items():
                if source.kind == kind:
                    return name
        return None
