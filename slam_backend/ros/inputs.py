"""Topics to the journal: raw subscriptions whose QoS fits the publishers that are there."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from time import monotonic
from typing import Any

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription

from ..core.config import Config
from ..core.sensors import SENSORS
from ..io.inputs import TF_STATIC

DEPTH = (
    10_000  # messages: ten seconds at 1,000 Hz; a full queue drops the oldest silently, even when reliable
)
Received = Callable[[str, str, bytes], None]  # topic, type, CDR
BEST_EFFORT, RELIABLE = ReliabilityPolicy.BEST_EFFORT, ReliabilityPolicy.RELIABLE
LATCHED, VOLATILE = DurabilityPolicy.TRANSIENT_LOCAL, DurabilityPolicy.VOLATILE
MARK = "/map_to_odom"  # how the outputs of a node like this are known: they lie beside it


@dataclass(slots=True)
class Flow:
    """What is known of one topic, for the diagnostics."""

    type: str
    count: int = 0
    newest: float = 0.0  # s on the monotonic clock; 0: nothing yet
    since: float = field(default_factory=monotonic)
    publishers: int = 0
    qos: str = ""
    incompatible: str = ""
    twins: set[bytes] | None = None  # while two subscriptions hear the same messages

    def rate(self) -> float:
        """Messages per second since the last call."""
        now = monotonic()
        rate, self.count, self.since = self.count / max(now - self.since, 1e-3), 0, now
        return rate

    def is_first(self, data: bytes) -> bool:
        """Count a message; False if it has been heard already."""
        self.newest = monotonic()
        if self.twins is not None:
            if data in self.twins:
                return False
            self.twins.add(data)
        self.count += 1
        return True


class Inputs:
    """Subscribes to the topics of the sources; with `finding`, also to everything that could be one.

    unreadable: topic of a source -> the types on it, where its kind can read none of them.
    """

    def __init__(self, node: Node, received: Received, *, finding: bool) -> None:
        self._node, self._received, self._finding = node, received, finding
        self._subscriptions: dict[str, tuple[Subscription, ReliabilityPolicy, DurabilityPolicy]] = {}
        self._retired: list[tuple[Subscription, Flow]] = []
        self._ignored: set[str] = set()
        self._static: str = node.resolve_topic_name(TF_STATIC)
        self.flows: dict[str, Flow] = {}
        self.unreadable: dict[str, str] = {}

    def look(self, config: Config) -> None:
        """Subscribe to what has appeared on the graph since the last look; cheap enough for several times a second."""
        for subscription, flow in self._retired:
            self._node.destroy_subscription(subscription)
            flow.twins = None
        self._retired.clear()
        for topic, type_ in self._wanted(config).items():
            offered = [info.qos_profile for info in self._node.get_publishers_info_by_topic(topic)]
            if offered:
                self._match(topic, type_, offered)
            elif topic in self.flows:
                self.flows[topic].publishers = 0

    def ignore(self, topic: str) -> None:
        """What came on it is of no use: listen no more."""
        self._ignored.add(topic)
        self.flows.pop(topic, None)
        if topic in self._subscriptions:
            self._node.destroy_subscription(self._subscriptions.pop(topic)[0])

    def close(self) -> None:
        for subscription, *_ in (*self._subscriptions.values(), *self._retired):
            self._node.destroy_subscription(subscription)
        self._subscriptions.clear()
        self._retired.clear()

    def _wanted(self, config: Config) -> dict[str, str]:
        """Topics that are on the graph and can be read: topic -> type."""
        kinds = {topic: source.kind for source in config.sources.values() for topic in source.topics}
        there = dict(self._node.get_topic_names_and_types())
        home = str(self._node.get_namespace()).rstrip("/") + "/"
        foreign = tuple(topic.removesuffix(MARK[1:]) for topic in there if topic.endswith(MARK))
        found: dict[str, str] = {}
        self.unreadable.clear()
        for topic, types in there.items():
            if topic == self._static:
                readable: Sequence[str] = tuple(SENSORS["static"].decoders)
            elif topic in kinds:
                readable = tuple(SENSORS[kinds[topic]].decoders)
            elif not self._finding or topic in self._ignored or topic.startswith(foreign):
                continue
            else:
                readable = _ANYTHING if topic.startswith(home) else ()
            fits = [type_ for type_ in types if type_ in readable and _message_class(type_) is not None]
            if fits:
                found[topic] = fits[0]
            elif topic in kinds:
                self.unreadable[topic] = ", ".join(types)
        return found

    def _match(self, topic: str, type_: str, offered: Sequence[QoSProfile]) -> None:
        """A subscription that hears all of these publishers, as far as one can."""
        latched = topic == self._static or all(qos.durability == LATCHED for qos in offered)
        reliability = BEST_EFFORT if any(qos.reliability == BEST_EFFORT for qos in offered) else RELIABLE
        durability = LATCHED if latched else VOLATILE
        present = self._subscriptions.get(topic)
        if present is not None:  # it hears more rather than less, whoever leaves
            reliability = BEST_EFFORT if present[1] == BEST_EFFORT else reliability
            durability = VOLATILE if present[2] == VOLATILE else durability
        if present is None or present[1:] != (reliability, durability):
            self._subscribe(topic, type_, reliability, durability)
        flow = self.flows[topic]
        flow.publishers = len(offered)
        unheard = sum(durability == LATCHED and qos.durability != LATCHED for qos in offered)
        flow.incompatible = (
            f"QoS: {unheard} of {len(offered)} publishers offer volatile durability where transient local is needed"
            if unheard
            else ""
        )

    def _subscribe(
        self, topic: str, type_: str, reliability: ReliabilityPolicy, durability: DurabilityPolicy
    ) -> None:
        flow = self.flows.setdefault(topic, Flow(type_))
        flow.qos = f"{reliability.name.lower()}, {durability.name.lower()}"
        if topic in self._subscriptions:  # the old one goes at the next look: in between nothing is missed
            flow.twins = set()
            self._retired.append((self._subscriptions[topic][0], flow))
        qos = QoSProfile(
            history=HistoryPolicy.KEEP_LAST, depth=DEPTH, reliability=reliability, durability=durability
        )
        name = TF_STATIC if topic == self._static else topic

        def received(data: bytes) -> None:
            if flow.is_first(data):
                self._received(name, type_, data)

        subscription = self._node.create_subscription(
            _message_class(type_), topic, received, qos, raw=True,
            event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=False),
        )  # fmt: skip
        self._subscriptions[topic] = (subscription, reliability, durability)
        self._node.get_logger().info(f"listening to {topic} ({type_}; {flow.qos})")


_ANYTHING: Sequence[str] = [
    type_ for kind, sensor in SENSORS.items() if kind != "static" for type_ in sensor.decoders
]
_classes: dict[str, Any] = {}


def _message_class(type_: str) -> Any:
    """The class of a type, to declare a subscription with; None where its package is not installed."""
    if type_ not in _classes:
        package, _, name = type_.split("/")
        try:
            _classes[type_] = getattr(import_module(f"{package}.msg"), name)
        except (ImportError, AttributeError):
            _classes[type_] = None
    return _classes[type_]
