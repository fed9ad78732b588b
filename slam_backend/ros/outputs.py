"""What the node publishes: bytes of `io.encode` on the topics of the table OUTPUTS.

Nothing is encoded for nobody. A volatile topic without listeners is left alone; of a transient-local one the newest content
is kept, and encoded when the first listener comes. Call from the executor's thread only.
"""

from collections.abc import Callable, Iterable, Sequence
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from nav_msgs.msg import Odometry, Path
from numpy.typing import ArrayLike
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import PointCloud2
from visualization_msgs.msg import MarkerArray

from ..core.backend import Update
from ..core.config import Config
from ..core.graph import Decision
from ..core.trajectory import Snapshot
from ..io.drawing import drawn_graph, landmark_cloud, newest, status_of, trajectory_cloud
from ..io.encode import (
    encode_diagnostics,
    encode_markers,
    encode_odometry,
    encode_path,
    encode_pose_with_covariance,
    encode_transform,
    encode_transforms,
)
from .pose import UNKNOWN

LATCHED = QoSProfile(
    depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)


def _reliable(depth: int) -> QoSProfile:
    return QoSProfile(depth=depth, reliability=ReliabilityPolicy.RELIABLE)


OUTPUTS: dict[str, tuple[Any, QoSProfile]] = {  # name below the node's own -> type, QoS
    "odometry": (Odometry, _reliable(10)),
    "pose": (PoseWithCovarianceStamped, _reliable(10)),
    "path": (Path, LATCHED),
    "trajectory": (PointCloud2, LATCHED),
    "landmarks": (PointCloud2, LATCHED),
    "graph": (MarkerArray, LATCHED),
    "decisions": (DiagnosticArray, _reliable(100)),
    "map_to_odom": (TransformStamped, _reliable(10)),
}
TF = "/tf"

STATUSES = 100  # per message


class Outputs:
    """The publishers of a node; plain ones, which `set_active` silences, so that what is due survives an inactive time.

    config: replace it when a live setting changes. odom_frame, base_frame: replace them when the odometry tells its own.
    """

    def __init__(
        self,
        node: Node,
        config: Config,
        map_frame: str = "map",
        odom_frame: str = "odom",
        base_frame: str = "",
    ) -> None:
        self.config = config
        self.map_frame, self.odom_frame = map_frame, odom_frame
        self.base_frame = base_frame or config.base_frame or "base_link"
        self._node, self._active = node, True
        self._due: dict[str, Callable[[], bytes]] = {}  # of latched topics: what nobody has heard yet
        self._publishers = {name: self._publisher(f"~/{name}", *what) for name, what in OUTPUTS.items()}
        try:
            from tf2_msgs.msg import TFMessage
        except ImportError:
            node.get_logger().warning(
                "tf2_msgs cannot be imported: map -> odom is published on ~/map_to_odom, and not on /tf",
                once=True,
            )
        else:
            self._publishers[TF] = self._publisher(TF, TFMessage, _reliable(100))

    def close(self) -> None:
        """Destroy the publishers."""
        for publisher in self._publishers.values():
            self._node.destroy_publisher(publisher)
        self._publishers.clear()
        self._due.clear()

    def set_active(self, active: bool) -> None:
        """An inactive node publishes nothing; when it is active again, what is due goes out."""
        self._active = active
        for topic in tuple(self._due):
            self._tell(topic)

    def has_listeners(self, topic: str) -> bool:
        """topic: a name of OUTPUTS, or TF; false while inactive. Worth asking before fetching a snapshot."""
        publisher = self._publishers.get(topic)
        return self._active and publisher is not None and publisher.get_subscription_count() > 0

    # -- at the rate of the odometry ---------------------------------------------------------------

    def odometry(
        self,
        stamp: int,
        map_T_base: ArrayLike,
        covariance: ArrayLike,
        child: str = "",
        twist: ArrayLike = (0.0,) * 6,
        twist_covariance: ArrayLike = (0.0,) * 36,
    ) -> None:
        """stamp: ns; pose: seven; covariances: 36 in ROS order; twist in the frame `child`, by default the base."""
        if self.has_listeners("odometry"):
            frames = self.map_frame, child or self.base_frame
            self._publishers["odometry"].publish(
                encode_odometry(stamp, *frames, map_T_base, covariance, twist, twist_covariance)
            )

    def map_to_odom(self, stamp: int, map_T_odom: ArrayLike) -> None:
        """stamp: ns; pose: seven."""
        if self.has_listeners("map_to_odom"):
            data = encode_transform(stamp, self.map_frame, self.odom_frame, map_T_odom)
            self._publishers["map_to_odom"].publish(data)
        if self.has_listeners(TF):
            data = encode_transforms(stamp, self.map_frame, {self.odom_frame: map_T_odom})
            self._publishers[TF].publish(data)

    # -- at each keyframe --------------------------------------------------------------------------

    def pose(self, update: Update, covariance: ArrayLike | None) -> None:
        """covariance: 36 in ROS order; None: not determined, published as UNKNOWN."""
        if self.has_listeners("pose"):
            known = UNKNOWN if covariance is None else covariance
            stamp = update.keyframe.stamp
            self._publishers["pose"].publish(
                encode_pose_with_covariance(stamp, self.map_frame, update.pose, known)
            )

    def decisions(self, decisions: Sequence[Decision]) -> None:
        """One status each, stamped by the node's clock. Costs about 30 us per decision."""
        if not self.has_listeners("decisions"):
            return
        now = self._node.get_clock().now().nanoseconds
        for begin in range(0, len(decisions), STATUSES):
            statuses = [status_of(decision) for decision in decisions[begin : begin + STATUSES]]
            self._publishers["decisions"].publish(encode_diagnostics(now, statuses))

    # -- from a snapshot ---------------------------------------------------------------------------

    def path(self, snapshot: Snapshot) -> None:
        """The newest `path.poses` keyframes."""
        begin = max(len(snapshot.stamps) - self.config.path.poses, 0)
        stamps, sevens = snapshot.stamps[begin:], snapshot.trajectory.sevens[begin:]
        self._latch("path", lambda: encode_path(self.map_frame, newest(snapshot), stamps, sevens))

    def trajectory(self, snapshot: Snapshot, covariances: ArrayLike | None = None) -> None:
        """Every keyframe. covariances: (N, 36) in ROS order."""
        frame = self.map_frame
        self._latch("trajectory", lambda: trajectory_cloud(newest(snapshot), frame, snapshot, covariances))

    def landmarks(self, snapshot: Snapshot, covariances: ArrayLike | None = None) -> None:
        """Every landmark. covariances: (L, 3, 3) in the map, m^2."""
        frame = self.map_frame
        self._latch("landmarks", lambda: landmark_cloud(newest(snapshot), frame, snapshot, covariances))

    def graph(self, snapshot: Snapshot, decisions: Iterable[Decision]) -> None:
        """Odometry, loops by verdict (the last one of each id holds), landmarks."""
        told, width = tuple(decisions), self.config.keyframes.distance / 10
        self._latch(
            "graph",
            lambda: encode_markers(newest(snapshot), self.map_frame, drawn_graph(snapshot, told, width)),
        )

    # ----------------------------------------------------------------------------------------------

    def _publisher(self, topic: str, type_: Any, qos: QoSProfile) -> Publisher:
        name = topic.removeprefix("~/")
        events = PublisherEventCallbacks(matched=lambda _: self._tell(name)) if qos is LATCHED else None
        return self._node.create_publisher(type_, topic, qos, event_callbacks=events)

    def _latch(self, topic: str, encode: Callable[[], bytes]) -> None:
        self._due[topic] = encode
        self._tell(topic)

    def _tell(self, topic: str) -> None:
        """Publish what is due, if anybody listens."""
        if topic in self._due and self.has_listeners(topic):
            self._publishers[topic].publish(self._due.pop(topic)())
