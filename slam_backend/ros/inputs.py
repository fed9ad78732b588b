"""Topics to the journal: raw subscriptions whose QoS fits the publishers that are there."""

from collections.abc import Callable, Mapping
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

DEPTH = 2000  # messages; a full queue drops the oldest silently, even when reliable
Received = Callable[[str, str, bytes], None]  # topic, type, CDR


@dataclass(slots=True)
class Flow:
    """What is known of one topic, for the diagnostics."""

    type: str
    count: int = 0
    newest: float = 0.0  # s on the monotonic clock
    since: float = field(default_factory=monotonic)
    reliability: str = ""
    incompatible: str = ""

    def rate(self) -> float:
        """Messages per second since the last call."""
        now = monotonic()
        rate, self.count, self.since = self.count / max(now - self.since, 1e-3), 0, now
        return rate


class Inputs:
    """Subscribes to the topics of the sources, or to everything that could be one when there are none."""

    def __init__(self, node: Node, received: Received) -> None:
        self._node, self._received = node, received
        self._subscriptions: dict[str, tuple[Subscription, ReliabilityPolicy, DurabilityPolicy]] = {}
        self.flows: dict[str, Flow] = {}

    def look(self, config: Config) -> None:
        """Subscribe to what has appeared on the graph since the last look; cheap enough for twice a second."""
        for topic, type_ in self._wanted(config).items():
            offered = [info.qos_profile for info in self._node.get_publishers_info_by_topic(topic)]
            if not offered:
                continue
            best_effort = any(qos.reliability == ReliabilityPolicy.BEST_EFFORT for qos in offered)
            latched = all(qos.durability == DurabilityPolicy.TRANSIENT_LOCAL for qos in offered)
            reliability = ReliabilityPolicy.BEST_EFFORT if best_effort else ReliabilityPolicy.RELIABLE
            durability = DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE
            present = self._subscriptions.get(topic)
            if present is None or (best_effort and present[1] == ReliabilityPolicy.RELIABLE):
                self._subscribe(topic, type_, reliability, durability)

    def close(self) -> None:
        for subscription, *_ in self._subscriptions.values():
            self._node.destroy_subscription(subscription)
        self._subscriptions.clear()

    def _wanted(self, config: Config) -> dict[str, str]:
        """Topics that are on the graph and can be read: topic -> type."""
        resolve = self._node.resolve_topic_name
        sources = {resolve(source.topic): source.kind for source in config.sources.values()}
        found: dict[str, str] = {}
        own = self._node.get_fully_qualified_name() + "/"
        for topic, types in self._node.get_topic_names_and_types():
            for type_ in types:
                if topic == TF_STATIC:
                    fits = type_ in SENSORS["static"].decoders
                elif sources:
                    fits = topic in sources and type_ in SENSORS[sources[topic]].decoders
                else:
                    fits = not topic.startswith(own) and type_ in _ANYTHING
                if fits and _message_class(type_) is not None:
                    found[topic] = type_
        return found

    def _subscribe(
        self, topic: str, type_: str, reliability: ReliabilityPolicy, durability: DurabilityPolicy
    ) -> None:
        if topic in self._subscriptions:
            self._node.destroy_subscription(self._subscriptions[topic][0])
        qos = QoSProfile(
            history=HistoryPolicy.KEEP_LAST, depth=DEPTH, reliability=reliability, durability=durability
        )
        flow = self.flows.setdefault(topic, Flow(type_))
        flow.reliability = reliability.name.lower()

        def received(data: bytes) -> None:
            flow.count += 1
            flow.newest = monotonic()
            self._received(topic, type_, data)

        def incompatible(info: Any) -> None:
            flow.incompatible = (
                f"a publisher's {info.last_policy_kind.name.lower()} does not fit our subscription"
            )

        subscription = self._node.create_subscription(
            _message_class(type_), topic, received, qos, raw=True,
            event_callbacks=SubscriptionEventCallbacks(incompatible_qos=incompatible, use_default_callbacks=False),
        )  # fmt: skip
        self._subscriptions[topic] = (subscription, reliability, durability)
        self._node.get_logger().info(f"listening to {topic} ({type_}, {flow.reliability})")


_ANYTHING: Mapping[str, None] = {
    type_: None for kind, sensor in SENSORS.items() if kind != "static" for type_ in sensor.decoders
}


def _message_class(type_: str) -> Any:
    """The class of a type, to declare a subscription with; None where its package is not installed."""
    package, _, name = type_.split("/")
    try:
        return getattr(import_module(f"{package}.msg"), name)
    except (ImportError, AttributeError):
        return None
