"""/diagnostics: what each input sends, what was refused, how the worker does."""

from collections.abc import Mapping
from math import atan2, sqrt
from time import monotonic
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray

from ..core.config import Config
from ..io.encode import Status, encode_diagnostics
from ..io.feeder import Feeder
from ..io.journal import Journal
from .inputs import Flow
from .state import State

OK, WARN, ERROR = 0, 1, 2
SILENT = 3.0  # s without a message after which a source is silent
BEHIND = 2000  # rows that the worker has yet to read, beyond which it is behind


class Diagnostics:
    def __init__(self, node: Any, state: State) -> None:
        self._node, self._state = node, state
        self._publisher = node.create_publisher(DiagnosticArray, "/diagnostics", 10)

    def publish(
        self, flows: Mapping[str, Flow], feeder: Feeder | None, journal: Journal | None, config: Config
    ) -> None:
        name, resolve = self._node.get_name(), self._node.resolve_topic_name
        statuses = [
            _status(f"{name}: {source}", *self._source(source, flows.get(resolve(setting.topic))))
            for source, setting in config.sources.items()
        ]
        statuses.append(_status(f"{name}: solver", *self._worker(feeder, journal)))
        stamp = self._node.get_clock().now().nanoseconds
        self._publisher.publish(encode_diagnostics(stamp, statuses))

    def _source(self, source: str, flow: Flow | None) -> tuple[int, str, dict[str, str]]:
        refused = {rule: str(n) for (who, rule), n in self._state.refused.items() if who == source}
        if flow is None:
            return ERROR, "no publisher on the topic", refused
        age = monotonic() - flow.newest if flow.newest else float("inf")
        values = {"rate_hz": f"{flow.rate():.1f}", "age_s": f"{age:.2f}", "qos": flow.reliability, **refused}
        if flow.incompatible:
            return ERROR, flow.incompatible, values
        if age > SILENT:
            return WARN, "silent", values
        return (WARN, f"refused: {', '.join(refused)}", values) if refused else (OK, "receiving", values)

    def _worker(self, feeder: Feeder | None, journal: Journal | None) -> tuple[int, str, dict[str, str]]:
        report, update, incidents = self._state.report, self._state.update, self._state.incidents
        values: dict[str, str] = {"incidents": str(len(incidents))}
        if incidents:
            values["last_incident"] = incidents[-1]
        if feeder is None or journal is None:
            return WARN, "waiting for a source", values
        values |= {
            "alive": str(feeder.alive).lower(),
            "queue": str(feeder.backlog),
            "restarts": str(feeder.restarts),
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
        if not feeder.alive:
            return ERROR, "the worker is dead; another is being started", values
        if incidents:
            return ERROR, incidents[-1], values
        if feeder.backlog > BEHIND:
            return WARN, f"the worker is {feeder.backlog} records behind", values
        return OK, "solving", values


def _status(name: str, level: int, message: str, values: Mapping[str, str]) -> Status:
    return Status(level, name, message, "", values)
