"""Sources that nobody configured: what the topics of a robot are, from their first messages, while they come."""

from collections.abc import Mapping
from time import monotonic
from typing import Any

from ..core.config import Config, config_from, config_to
from ..core.errors import BadConfig
from ..core.sensors.odometry import TRANSFORMS
from ..io.discover import ASIDE, is_truth, kind_of, name_of
from ..io.records import Record

PATIENCE: Mapping[
    tuple[str, str], float
] = {  # s that a topic waits for a better one before it drives the keyframes
    ("odometry", "nav_msgs/msg/Odometry"): 0.0,
    ("odometry", TRANSFORMS): 3.0,
}
LONGEST = 6.0  # s; of all others: poses of an unknown kind, and relative poses or fixes without odometry


class Finder:
    """Of one session. unused: topics that turned out to be of no use."""

    def __init__(self, typestore: Any) -> None:
        self._typestore = typestore
        self._kinds: dict[str, str] = {}
        self._types: dict[str, str] = {}
        self._since: dict[str, float] = {}
        self.unused: dict[str, str] = {}  # topic -> why

    def wants(self, record: Record, config: Config) -> bool:
        """Whether the message is to be kept: its topic is a source, or may become one; of transforms, the odometry only."""
        known = _is_source(record.topic, config) or record.topic in self._kinds
        known = known and record.topic not in self.unused
        return known and (record.type != TRANSFORMS or kind_of(record, self._typestore) is not None)

    def look(self, record: Record, config: Config) -> Config:
        """The configuration; with this topic as a source, and those that waited for it, once it can be one."""
        topic = record.topic
        if topic in self.unused or _is_source(topic, config):
            return config
        if topic not in self._kinds and not self._recognize(record):
            return config
        if self._kinds[topic] == "odometry" and _has_odometry(config):
            self.unused[topic] = f"'{config.driver}' is the odometry"
            return config
        if not self._ready(topic, config):
            return config
        config = self._with(topic, config)
        for other in self._kinds:
            if other not in self.unused and self._kinds[other] in ("landmark", "pose", "gnss"):
                config = self._with(other, config)
        return config

    def _recognize(self, record: Record) -> bool:
        topic = record.topic
        if is_truth(topic):
            self.unused[topic] = "it is taken for ground truth"
            return False
        kind = kind_of(record, self._typestore)
        if kind is None:
            if record.type != TRANSFORMS:  # those may hold the odometry later
                self.unused[topic] = "it holds nothing that could be used"
            return False
        if kind == "imu":
            self.unused[topic] = ASIDE
            return False
        self._kinds[topic], self._types[topic], self._since[topic] = kind, record.type, monotonic()
        return True

    def _ready(self, topic: str, config: Config) -> bool:
        kind = self._kinds[topic]
        if config.driver is not None and kind != "odometry":
            return True
        if kind in ("landmark", "pose"):
            return False
        return monotonic() - self._since[topic] >= PATIENCE.get((kind, self._types[topic]), LONGEST)

    def _with(self, topic: str, config: Config) -> Config:
        if _is_source(topic, config):
            return config
        data, name = config_to(config), name_of(topic)
        while name in data or name in data["sources"]:
            name += "_"
        found = {"kind": self._kinds[topic], "topic": topic}
        try:
            return config_from({**data, "sources": [*data["sources"], name], name: found})
        except BadConfig as error:
            self.unused[topic] = str(error)
            return config


def _is_source(topic: str, config: Config) -> bool:
    return any(topic in source.topics for source in config.sources.values())


def _has_odometry(config: Config) -> bool:
    return config.driver is not None and config.sources[config.driver].kind == "odometry"
