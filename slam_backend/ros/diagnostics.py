"""/diagnostics: what each input sends, what was refused, how the worker does."""

from collections.abc import Iterable, Mapping
from math import atan2, sqrt
from time import monotonic
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray

from ..core.config import Config
from ..core.firewall.rules import Severity, rule_of
from ..io.encode import Status, encode_diagnostics
from ..io.feeder import Feeder
from ..io.inputs import TF_STATIC
from ..io.journal import Journal
from .inputs import Inputs
from .state import State

OK, WARN, ERROR = 0, 1, 2
LEVELS: Mapping[Severity, int] = {"note": OK, "warn": WARN, "error": ERROR}
SILENT = 3.0  # s without a message after which a source is silent
DEAD = 10.0  # s after which the log says of a topic that it was never heard: drivers take as long to start
FRESH = 10.0  # s for which an incident is the news
BEHIND = 2000  # rows that the worker has yet to read, beyond which it is behind

CORRECTIONS = (
    "correction_m",
    "correction_rad",
)  # of an odometry; nobody has published one that fixes or edges make


class Diagnostics:
    def __init__(self, node: Any, state: State) -> None:
        self._node, self._state = node, state
        self._said: dict[
            tuple[str, str], tuple[int, float]
        ] = {}  # (source, rule) -> count, when it last grew
        self._warned: set[tuple[str, str]] = set()  # source, rule: what the log has been told of
        self._begun = monotonic()
        self._publisher = node.create_publisher(DiagnosticArray, "/diagnostics", 10)

    def close(self) -> None:
        self._node.destroy_publisher(self._publisher)

    def publish(self, inputs: Inputs, feeder: Feeder | None, journal: Journal | None, config: Config) -> None:
        name = self._node.get_name()
        statuses = [
            _status(f"{name}: {source}", *self._source(source, setting.topic, inputs))
            for source, setting in config.sources.items()
        ]
        if monotonic() - self._begun > DEAD:
            self._miss(inputs, config)
        static = inputs.flows.get(self._node.resolve_topic_name(TF_STATIC))
        if static is not None and static.incompatible:
            statuses.append(_status(f"{name}: {TF_STATIC}", ERROR, static.incompatible, {"qos": static.qos}))
        level, message, values = self._worker(feeder, journal)
        if config.driver is not None and config.sources[config.driver].kind not in ("odometry", "imu"):
            values = {key: value for key, value in values.items() if key not in CORRECTIONS}
        statuses.append(_status(f"{name}: solver", level, message, values))
        stamp = self._node.get_clock().now().nanoseconds
        self._publisher.publish(encode_diagnostics(stamp, statuses))

    def _source(self, source: str, topic: str, inputs: Inputs) -> tuple[int, str, dict[str, str]]:
        told = {
            rule: n
            for counts in (self._state.noted, self._state.refused)
            for (who, rule), n in list(counts.items())
            if who == source
        }
        self._warn(source, told)
        fit = self._state.consistency.get(source, {})
        values = {
            "topic": topic,
            **self._state.conditions.get(source, {}),
            **{rule: str(n) for rule, n in told.items()},
        }
        if "ratio" in fit:
            low, high = fit["bounds_95"]
            values |= {
                "nis": f"{fit['ratio']:.2f}",
                "nis_bounds": f"{low:.2f} to {high:.2f}",
                "noise": fit["advice"],
            }
        if topic in inputs.unreadable:
            return ERROR, f"the topic has {inputs.unreadable[topic]}, which its kind cannot read", values
        flow = inputs.flows.get(topic)
        if flow is None:
            return ERROR, "no publisher on the topic", values
        values |= {"rate_hz": f"{flow.rate():.1f}", "publishers": str(flow.publishers), "qos": flow.qos}
        age = monotonic() - flow.newest if flow.newest else None
        if age is not None:
            values["age_s"] = f"{age:.2f}"
        if flow.incompatible:
            return ERROR, flow.incompatible, values
        if not flow.publishers:
            return ERROR, "its publisher is gone", values
        if age is None or age > SILENT:
            return WARN, "silent" if age is None else f"silent for {age:.0f} s", values
        return (*self._verdict(source, told), values)

    def _warn(self, source: str, told: Iterable[str]) -> None:
        """In the log, once: what makes a source of no use until it is mended."""
        for id_ in told:
            rule = rule_of(id_)
            if rule is not None and rule.severity == "error" and (source, id_) not in self._warned:
                self._warned.add((source, id_))
                self._node.get_logger().warning(f"source '{source}': {id_}: {rule.what}; {rule.advice}")

    def _miss(self, inputs: Inputs, config: Config) -> None:
        """In the log, once: a topic of a source that has never been heard, and why that may be."""
        for source, setting in config.sources.items():
            for topic in setting.topics:
                flow = inputs.flows.get(topic)
                if (flow is not None and flow.newest) or (source, topic) in self._warned:
                    continue
                self._warned.add((source, topic))
                if topic in inputs.unreadable:
                    why = f"it has {inputs.unreadable[topic]}, which its kind cannot read"
                elif flow is None:
                    why = "it has no publisher; see `ros2 topic list`"
                else:
                    why = flow.incompatible or f"{flow.publishers} publish it and send nothing"
                self._node.get_logger().warning(f"source '{source}': nothing heard yet on {topic}: {why}")

    def _verdict(self, source: str, told: Mapping[str, int]) -> tuple[int, str]:
        """By the firewall's table: the worst of what it has said lately, and what to do about it; else whether its noise is true."""
        now, news = monotonic(), []
        for id_, count in told.items():
            before, when = self._said.get((source, id_), (0, 0.0))
            when = now if count != before else when
            self._said[source, id_] = (count, when)
            if now - when < FRESH:
                news.append(id_)
        worst = max(news, key=lambda id_: LEVELS[_severity(id_)], default=None)
        if worst is None:
            advice = self._state.consistency.get(source, {}).get("advice")
            return (WARN, f"receiving; its noise is {advice}") if advice else (OK, "receiving")
        rule = rule_of(worst)
        advice = f": {rule.what}; {rule.advice}" if rule is not None else ""
        verb = "refused" if any((source, id_) in self._state.refused for id_ in news) else "kept"
        return LEVELS[_severity(worst)], f"{verb}: {', '.join(sorted(news, key=worst.__ne__))}{advice}"

    def _worker(self, feeder: Feeder | None, journal: Journal | None) -> tuple[int, str, dict[str, str]]:
        report, update = self._state.report, self._state.update
        when, what = self._state.incidents[-1] if self._state.incidents else (0.0, "")
        values = {"incidents": str(len(self._state.incidents))}
        if what:
            values |= {"last_incident": what, "last_incident_age_s": f"{monotonic() - when:.0f}"}
        if feeder is None or journal is None:
            return WARN, "paused" if self._state.paused else "waiting for a source", values
        values |= {
            "alive": str(feeder.alive).lower(),
            "queue": str(feeder.backlog),
            "restarts": str(feeder.restarts),
            "acknowledged": str(journal.committed),
            "unwritten": str(journal.waiting),
            "lost": str(journal.lost),
        }
        if report is not None:
            values |= {
                "update_ms_p50": f"{report.update_ms[0]:.2f}",
                "update_ms_p99": f"{report.update_ms[1]:.2f}",
                "factors": str(report.factors),
                "memory_mb": f"{report.memory_mb:.0f}",
            }
        if update is not None:
            x, y, z, qx, qy, qz, qw = update.correction
            angle = 2 * atan2(sqrt(qx * qx + qy * qy + qz * qz), abs(qw))
            values |= {
                "keyframes": str(update.keyframe.index + 1),
                "revision": str(update.revision),
                "correction_m": f"{sqrt(x * x + y * y + z * z):.3f}",
                "correction_rad": f"{angle:.4f}",
            }
        return *self._how(feeder, journal), values

    def _how(self, feeder: Feeder, journal: Journal) -> tuple[int, str]:
        """The worst that there is to say of the worker."""
        when, what = self._state.incidents[-1] if self._state.incidents else (0.0, "")
        state, backlog = self._state, feeder.backlog
        for is_so, level, message in (
            (not feeder.alive, ERROR, "the worker is dead; another is being started"),
            (bool(journal.trouble), ERROR, journal.trouble),
            (bool(what) and monotonic() - when < FRESH, ERROR, what),
            (state.paused, WARN, f"paused; {backlog} records wait"),
            (state.restored < 1, WARN, f"restoring: {state.restored:.0%} of the session so far"),
            (backlog > BEHIND, WARN, f"the worker is {backlog} records behind"),
        ):
            if is_so:
                return level, message
        return OK, "solving"


def _severity(id_: str) -> Severity:
    """Of the firewall's rules by their table; what another stage refuses is worth a look."""
    rule = rule_of(id_)
    return "warn" if rule is None else rule.severity


def _status(name: str, level: int, message: str, values: Mapping[str, str]) -> Status:
    return Status(level, name, message, "", values)
