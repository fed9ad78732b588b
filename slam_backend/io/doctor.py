"""A recording as the firewall sees it: the judges of the live node and of `replay`, each topic with what to mend.

Nothing is solved. Without a configuration the topics are found by type, as `replay` finds them; where nothing can drive
the keyframes, there is still to say what was recorded, and what is missing.
"""

from array import array
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple, get_args

import numpy as np

from ..core.config import AnySource, Config
from ..core.errors import BadConfig
from ..core.firewall.rules import RULES, Severity, rule_of
from ..core.graph import Decision
from ..core.measurement import SECOND, Array, Constant, Measurement, StaticTransform
from ..core.mounts import Mounts
from ..core.sensors import SENSORS
from ..core.sensors.landmark import LandmarkObservation
from ..core.sensors.odometry import OdometryPose
from ..core.sensors.pixels import PixelFrame
from ..core.sensors.relative import RelativePose
from ..core.space import SPACES
from .discover import UNASKED, discover, is_truth
from .gravity import sideways
from .inputs import OWN, TF_STATIC, BagInputs, GraphInput, open_inputs
from .replay import settled_stream

GAP, USUAL = 1.0, 5.0  # s, and median steps: a longer step is a gap
MANY, SOME = (
    0.1,
    0.01,
)  # of a topic's measurements: refused by any rule, by one of severity error: it is serious
APART = 1.0  # s by which the delay from stamp to recording may differ from the driving source's
KINDS = [model.model_fields["kind"].default for model in get_args(get_args(AnySource)[0])]
SEVERITIES: Sequence[Severity] = ("note", "warn", "error")


class Finding(NamedTuple):
    """advice: what to do about it."""

    severity: Severity
    what: str
    advice: str


@dataclass
class Topic:
    """use: the kind of source, or empty. measurements: what its messages say; refused, noted: rule -> how often.

    rate: Hz; gaps: steps beyond GAP and USUAL; longest_gap: s. Stamps are those of what was kept, where the topic is used, else those
    of the recording.
    """

    name: str
    type: str
    use: str
    messages: int
    measurements: int = 0
    rate: float | None = None
    gaps: int = 0
    longest_gap: float = 0.0
    refused: dict[str, int] = field(default_factory=dict)
    noted: dict[str, int] = field(default_factory=dict)
    qos: str = ""
    findings: list[Finding] = field(default_factory=list)

    @property
    def severity(self) -> Severity | None:
        return worst(self.findings)


@dataclass
class Checkup:
    """findings: about the recording as a whole. notes: how the topics were chosen."""

    paths: list[str]
    space: str
    topics: list[Topic]
    findings: list[Finding]
    notes: list[str]

    @property
    def serious(self) -> bool:
        return "error" in (worst(self.findings), *(topic.severity for topic in self.topics))


def worst(findings: Iterable[Finding]) -> Severity | None:
    return max((finding.severity for finding in findings), key=SEVERITIES.index, default=None)


def examine(paths: Sequence[Path | str], config: Config | None = None) -> Checkup:
    """Read everything once. SlamError when an input cannot be read at all, or the configuration does not fit it."""
    notes: list[str] = []
    findings: list[Finding] = []
    with open_inputs(paths) as inputs:
        if config is None or not config.sources:
            try:
                config, notes = discover(inputs)
            except BadConfig:
                config = None
                advice = f"record odometry (nav_msgs/Odometry, or odom -> base on /tf), relative poses or fixes{UNASKED}"
                findings.append(Finding("error", "nothing in it can drive the keyframes", advice))
        watch = _Watch(config)
        if config is not None:
            watch.follow(inputs, config)
        log_times = _log_times(inputs)
        topics = [_topic(name, type_, inputs, watch, log_times) for name, type_ in _names(inputs, config)]
        _compare_clocks(topics, watch, log_times)
        if isinstance(inputs, BagInputs):
            _compare_gravity(topics, inputs, watch)
    findings += [
        Finding("error", line, "copy or record it again; what could be read is judged here")
        for line in inputs.damage
    ]
    space = config.space if config is not None else ""
    return Checkup([str(path) for path in inputs.paths], space, topics, findings, notes)


class _Watch:
    """What passes through the firewall, by source."""

    def __init__(self, config: Config | None) -> None:
        self.sources = (
            {}
            if config is None
            else {t or name: name for name, s in config.sources.items() for t in s.topics}
        )
        self.kinds = {} if config is None else {name: s.kind for name, s in config.sources.items()}
        self.driver = None if config is None else config.driver
        self.stamps: dict[str, array[int]] = defaultdict(lambda: array("q"))
        self.measurements: Counter[str] = Counter()
        self.refused: dict[str, Counter[str]] = defaultdict(Counter)
        self.noted: dict[str, Counter[str]] = defaultdict(Counter)
        self.unmounted: dict[str, Counter[str]] = defaultdict(Counter)  # source -> frame -> how often
        self._frames: dict[str, Counter[str]] = defaultdict(Counter)
        self.mounts = Mounts(SPACES["3d"], "", {})

    def follow(self, inputs: BagInputs | GraphInput, config: Config) -> None:
        """Everything of the input, to its end."""
        self.mounts = mounts = Mounts(SPACES[config.space], config.base_frame, config.extrinsics)
        for item in settled_stream(self._seen(inputs.stream(config)), config):
            if isinstance(item, Decision):
                counts = self.refused if item.verdict == "refused" else self.noted
                counts[item.source][f"{item.stage}/{item.reason}"] += item.count
                continue
            self.stamps[item.source].append(item.stamp)
            if isinstance(item, StaticTransform):
                mounts.add(item)
            elif isinstance(item, Constant):
                continue
            elif isinstance(item, OdometryPose) and item.source == self.driver:
                mounts.name_base(item.child)
            else:
                if isinstance(item, RelativePose) and item.source == self.driver:
                    mounts.name_base(item.frame_j)
                self._frames[item.source].update(_frames_of(item))
        for source, frames in self._frames.items():
            for frame, count in frames.items():
                if mounts.get(frame) is None:
                    self.unmounted[source][frame] = count
                    self.refused[source][f"{self.kinds[source]}/unknown_frame"] += count

    def _seen(self, items: Iterable[Measurement | Decision]) -> Iterator[Measurement | Decision]:
        for item in items:
            if not isinstance(item, Decision):
                self.measurements[item.source] += 1
            elif item.stage == "decode":
                self.measurements[item.source] += item.count
            yield item


def _frames_of(item: Measurement) -> set[str]:
    if isinstance(item, RelativePose):
        return {item.frame_i, item.frame_j}
    return {item.frame} if isinstance(item, LandmarkObservation | PixelFrame) else set()


def _log_times(inputs: BagInputs | GraphInput) -> dict[str, "array[int]"]:
    times: dict[str, array[int]] = defaultdict(lambda: array("q"))
    if isinstance(inputs, BagInputs):
        for topic, log_time in inputs.log_times(inputs.topics):
            times[topic].append(log_time)
    return times


def _names(inputs: BagInputs | GraphInput, config: Config | None) -> list[tuple[str, str]]:
    """Topics and their types, those in use first; of a graph file, its sources."""
    if isinstance(inputs, GraphInput):
        return [(name, source.kind) for name, source in config.sources.items()] if config else []
    used = (
        {topic for source in config.sources.values() for topic in source.topics} | {TF_STATIC}
        if config
        else set()
    )
    return sorted(
        ((name, topic.type) for name, topic in inputs.topics.items()), key=lambda t: t[0] not in used
    )


def _topic(
    name: str, type_: str, inputs: BagInputs | GraphInput, watch: _Watch, log_times: dict[str, "array[int]"]
) -> Topic:
    source = watch.sources.get(name, name)
    static = name == TF_STATIC and type_ in SENSORS["static"].decoders
    use = watch.kinds.get(source, "static" if static and watch.kinds else "")
    messages = inputs.topics[name].count if isinstance(inputs, BagInputs) else watch.measurements[source]
    topic = Topic(name, type_, use, messages, watch.measurements[source])
    if isinstance(inputs, BagInputs):
        topic.qos = inputs.qos.get(name, "")
    told = watch.stamps[source] if use and not static else log_times[name]
    stamps = np.unique(np.array(told or log_times[name], dtype=np.int64))
    if isinstance(inputs, BagInputs):  # the stamps of a graph file are made up
        _pace(topic, stamps)
    topic.refused, topic.noted = dict(watch.refused[source]), dict(watch.noted[source])
    if use:
        topic.findings += _judged(topic, source, watch)
    else:
        topic.findings.append(Finding("note", _unused(name, type_), ""))
    return topic


def _pace(topic: Topic, stamps: "np.ndarray[tuple[int], np.dtype[np.int64]]") -> None:
    if len(stamps) < 2:
        return
    steps: Array = np.diff(stamps) / SECOND
    topic.rate = float((len(stamps) - 1) / steps.sum())
    topic.gaps = int((steps > max(GAP, USUAL * float(np.median(steps)))).sum())
    topic.longest_gap = float(steps.max())


def _judged(topic: Topic, source: str, watch: _Watch) -> Iterator[Finding]:
    """What is wrong with a topic that is used."""
    total = max(topic.measurements, 1)
    if not topic.messages:
        yield Finding(
            "error", "holds no message", "see that its node was running and its QoS fits the recorder's"
        )
    elif sum(topic.refused.values()) >= total:
        yield Finding("error", "not one of its measurements can be used", "mend what is named below")
    elif sum(topic.refused.values()) >= MANY * total:
        share = sum(topic.refused.values()) / total
        yield Finding("error", f"{share:.0%} of its measurements are refused", "mend what is named below")
    for id_, count in {**topic.refused, **topic.noted}.items():
        if (rule := rule_of(id_)) is not None:
            severity: Severity = (
                "warn" if rule.severity == "error" and count < SOME * total else rule.severity
            )
            frames = f" ({', '.join(watch.unmounted[source])})" if id_.endswith("/unknown_frame") else ""
            yield Finding(severity, f"{count} x {id_}: {rule.what}{frames}", rule.advice)
    if source == watch.driver and topic.gaps:
        what = f"{topic.gaps} gap{'s'[: topic.gaps - 1]}, the longest {topic.longest_gap:.1f} s"
        yield Finding("warn", what, RULES["settle/gap"].advice)
    if topic.use == "static" and "volatile" in topic.qos:
        what = "/tf_static was published as volatile: a node that starts later never hears it"
        yield Finding("warn", what, "publish it as transient local")
    elif "best_effort" in topic.qos:
        yield Finding("note", "was published as best effort: some messages may never have been recorded", "")


def _unused(name: str, type_: str) -> str:
    if name in OWN:
        return "where sensors sit" if name == TF_STATIC else "of the node's journal"
    kinds = [kind for kind in KINDS if type_ in SENSORS[kind].decoders]
    if not kinds:
        return "no source reads this type"
    if is_truth(name):
        return "taken for ground truth and left aside"
    return f"not used; could be {' or '.join(kinds)}"


def _compare_gravity(topics: Sequence[Topic], inputs: BagInputs, watch: _Watch) -> None:
    """IMUs by which the robot would lie on its side, used or not."""
    tilts, rule = sideways(inputs, watch.mounts), RULES["imu/sideways"]
    for topic in topics:
        if topic.name in tilts:
            what = f"imu/sideways: {rule.what} (tilted by {tilts[topic.name]:.1f} rad)"
            topic.findings.append(Finding(rule.severity, what, rule.advice))


def _compare_clocks(topics: Sequence[Topic], watch: _Watch, log_times: dict[str, "array[int]"]) -> None:
    """Sources whose stamps lie further from their recording than the driving source's do."""
    delays = {
        topic.name: float(np.median(log_times[topic.name]) - np.median(stamps)) / SECOND
        for topic in topics
        if topic.use not in ("", "static", "relative")
        and log_times[topic.name]
        and len(stamps := watch.stamps[watch.sources.get(topic.name, topic.name)])
    }
    driving = next((t.name for t in topics if watch.sources.get(t.name) == watch.driver), "")
    for topic in topics:
        apart = delays.get(topic.name, 0.0) - delays.get(driving, 0.0)
        if topic.name in delays and driving in delays and abs(apart) > APART:
            what = f"its stamps lie {abs(apart):.1f} s {'behind' if apart > 0 else 'ahead of'} the driving source's"
            topic.findings.append(Finding("warn", what, RULES["settle/ahead"].advice))
