"""The node's services: short answers from what State holds; long work in threads, awaited.

No callback waits. One that has something to wait for is a coroutine: a thread does the work, the executor goes on with
other callbacks and takes the answer up when it is there. All share a reentrant group, or the first to wait would keep
the others out.
"""

import json
import threading
from collections.abc import Awaitable, Callable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from inspect import isawaitable
from pathlib import Path
from time import monotonic, sleep
from typing import Any, TypeVar

from nav_msgs.srv import LoadMap
from rcl_interfaces.msg import ParameterType, ParameterValue
from rcl_interfaces.srv import GetParameters, ListParameters, SetParametersAtomically
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.exceptions import InvalidHandle
from rclpy.node import Node
from rclpy.task import Future
from std_srvs.srv import SetBool, Trigger

from ..core.command import command, text_of
from ..core.config import Config
from ..core.errors import BadConfig, SlamError
from ..core.graph import Decision
from ..core.measurement import Array, format_stamp
from ..core.query import PAST, answers, question
from ..core.sessions import fits
from ..core.trajectory import Snapshot
from ..io.feeder import Feeder
from ..io.historian import Question
from ..io.mapfile import read_map
from .answers import Answers
from .believed import Believed
from .editing import edit_in
from .session import Begin, Session, empty
from .shelf import Shelf
from .state import State

ACTING = 120.0  # s that it may take to come to a command, and to carry it out
FRESH, FIRST = 0.2, 5.0  # s that an answer may wait for a newer snapshot, and for the first of all
LOOK = 0.003  # s between two looks for it
REVISION = "revision"  # as a name in a query: of the snapshot that answered
T = TypeVar("T")
Value = Array | Mapping[str, Any] | int | None
Content = Mapping[str, Any]
NO_SESSION = "there is no session: no source has been heard yet"


class Services:
    """session_of: the present session, None without one. refresh: asks for a newer snapshot without waiting for it.
    reset: begins a new session; called in a thread of its own.
    """

    def __init__(
        self,
        node: Node,
        state: State,
        session_of: Callable[[], Session | None],
        refresh: Callable[[], None],
        data_dir: Path,
        config: Config,
        reset: Callable[[Begin], None],
    ) -> None:
        self._node, self._state, self._config = node, state, config
        self._shelf = Shelf(data_dir)
        self._session_of, self._refresh, self._reset = session_of, refresh, reset
        self._closed = False
        self._resetting = threading.Lock()
        group = ReentrantCallbackGroup()
        table: dict[str, tuple[Any, Any]] = {
            "query": (GetParameters, self._query),
            "list": (ListParameters, self._list),
            "edit": (SetParametersAtomically, self._edit),
            "load": (LoadMap, self._load),
            "pause": (SetBool, self._pause),
            "save": (Trigger, _told(self._save)),
            "reset": (Trigger, _told(self._begin_anew)),
        } | {
            name: (Trigger, _told(partial(self._command, name, {}))) for name in ("optimize", "undo", "redo")
        }
        self._services = [
            node.create_service(type_, f"~/{name}", self._survived(callback), callback_group=group)
            for name, (type_, callback) in table.items()
        ]
        self._answers = Answers(
            node.resolve_service_name("~/get_trajectory"), node.get_namespace(), config.map_frame, self.believed,
            node.get_logger().error,
        )  # fmt: skip

    def close(self) -> None:
        """Answer no more; safe to call twice."""
        self._closed = True
        for service in self._services:
            self._node.destroy_service(service)
        self._services = []
        self._answers.close()

    def _feeder_of(self) -> Feeder | None:
        session = self._session_of()
        return session.feeder if session is not None else None

    def newest(self) -> Snapshot | None:
        """The newest snapshot; when keyframes have been added since, one with them if it comes in time. Waits."""
        held, update = self._state.snapshot, self._state.update
        until = monotonic() + (FIRST if held is None else FRESH)
        if update is None or (held is not None and len(held.indices) > update.keyframe.index):
            return held
        self._refresh()
        while self._state.snapshot is held and monotonic() < until:
            sleep(LOOK)
        return self._state.snapshot

    # -- what is known ---------------------------------------------------------------------------

    async def _query(self, request: GetParameters.Request, response: GetParameters.Response) -> Any:
        """At once if all is known; else with the help of the worker: covariances, and a newer snapshot if one is to come."""
        found = self._known(request.names, self._state.snapshot, None)
        if any(value is None or _may_be_known_by_now(value) for value in found.values()):
            with suppress(SlamError):  # then it stays unknown
                found = await self._elsewhere(
                    lambda: self._known(request.names, self.newest(), self._session_of())
                )
        response.values = [_parameter(found[name]) for name in request.names]
        return response

    def _known(
        self, names: Sequence[str], snapshot: Snapshot | None, session: Session | None
    ) -> dict[str, Value]:
        """Name -> answer, None where there is none. Without a session nothing waits."""
        found: dict[str, Value] = dict.fromkeys(names)
        if snapshot is None:
            return found
        feeder, historian = (session.feeder, session.historian) if session else (None, None)
        known = Believed(snapshot, self._state.decided, self._config, feeder, historian)
        asked: list[str] = []
        for name in found:
            if name == REVISION:
                found[name] = snapshot.revision
            else:
                with suppress(BadConfig):  # no name that could be known
                    question(name)
                    asked.append(name)
        return found | {answer.name: answer.value for answer in answers(asked, known)}

    def believed(self, stamp: int | None) -> Snapshot | None:
        """The newest snapshot, or what was believed at a stamp. Waits. SlamError where that cannot be told."""
        if stamp is None:
            return self.newest()
        session = self._session_of()
        if session is None or session.historian is None:
            raise SlamError(NO_SESSION)
        found: Snapshot = session.historian.ask(Question("snapshot", stamp))
        return found

    def _list(self, request: ListParameters.Request, response: ListParameters.Response) -> Any:
        """Without prefixes the groups; with `group`, or `group/beginning`, the names that can be queried."""
        groups = self._groups()
        if not request.prefixes:
            response.result.prefixes = sorted(groups)
        for prefix in request.prefixes:
            group, _, beginning = prefix.partition("/")
            if group in groups:
                head, ids = groups[group]()
                response.result.names += [head + id_ for id_ in ids if id_.startswith(beginning)]
        return response

    def _groups(self) -> dict[str, Callable[[], tuple[str, list[str]]]]:
        """Group -> what the name of a member begins with, and how it goes on."""
        snapshot = self._state.snapshot
        decided = list(self._state.decided.values())  # in one step: another thread adds to it
        revisions = list(self._state.revisions)
        return {
            "decisions": lambda: ("decision/", [d.id for d in decided]),
            "keyframes": lambda: (
                "pose@",
                [format_stamp(stamp) for stamp in snapshot.stamps.tolist()] if snapshot else [],
            ),
            "landmarks": lambda: ("landmark/", list(snapshot.names) if snapshot else []),
            "loops": lambda: ("decision/", [d.id for d in decided if d.ends is not None]),
            "revisions": lambda: ("", [*[REVISION][: snapshot is not None], *map(_then, revisions)]),
        }

    # -- what is to be done ----------------------------------------------------------------------

    async def _save(self) -> Content:
        """A run directory under the data directory."""
        feeder = self._feeder_of()
        if feeder is None or self._state.update is None:
            raise SlamError(
                "there is nothing to save yet: no message of the driving source has been accepted"
            )
        asked = feeder.request
        return await self._elsewhere(lambda: self._shelf.save(asked))

    async def _command(self, action: str, arguments: Mapping[str, Any]) -> Content:
        """What came of a command that went by way of the journal. SlamError says why it was not carried out."""
        session = self._session_of()
        if session is None:
            raise SlamError(NO_SESSION)
        decision = await self._elsewhere(lambda: self._carried_out(session, action, arguments))
        if decision.verdict != "accepted":
            raise SlamError(decision.detail)
        return decision.basis

    def _carried_out(self, session: Session, action: str, arguments: Mapping[str, Any]) -> Decision:
        """And what is asked from now on is answered from the map as it is by then."""
        decision = session.command(action, arguments, ACTING)
        if session.feeder is not None:
            with suppress(SlamError):
                self._state.show(session.feeder.request("snapshot", timeout=ACTING))
        return decision

    async def _begin_anew(self) -> Content:
        await self._anew(empty)
        return {"session": "new"}

    async def _anew(self, begin: Begin) -> None:
        if not self._resetting.acquire(blocking=False):
            raise SlamError("a reset is under way already")
        try:
            await self._elsewhere(lambda: self._reset(begin))
        finally:
            self._resetting.release()

    def _pause(self, request: SetBool.Request, response: SetBool.Response) -> Any:
        """Holds for sessions to come, too."""
        self._state.paused = request.data
        feeder = self._feeder_of()
        if feeder is not None:
            feeder.pause(request.data)
        response.success = True
        response.message = json.dumps({"paused": request.data, "backlog": feeder.backlog if feeder else 0})
        return response

    async def _edit(
        self, request: SetParametersAtomically.Request, response: SetParametersAtomically.Response
    ) -> Any:
        """All or nothing. A dry run asks the worker, and leaves the journal alone."""
        try:
            arguments, dry = edit_in(request.parameters)
            answer = await (self._tried(arguments) if dry else self._command("edit", arguments))
            response.result.reason, response.result.successful = json.dumps(answer), True
        except SlamError as error:
            response.result.reason = json.dumps({"error": str(error)})
        return response

    async def _tried(self, arguments: Mapping[str, Any]) -> Content:
        feeder = self._feeder_of()
        if feeder is None:
            raise SlamError(NO_SESSION)
        asked = text_of(command("dry run", "edit", arguments))
        told: Content = await self._elsewhere(lambda: feeder.request("dry_run", asked, ACTING))
        return told

    async def _load(self, request: LoadMap.Request, response: LoadMap.Response) -> Any:
        """A new session in the map of a run; what goes wrong is a line of the log, since the type has no room for it."""
        try:
            run = self._shelf.find(request.map_url)
            saved = await self._elsewhere(lambda: read_map(run))
            if self._config.sources:  # else its space is still to be found
                fits(saved, self._config.space)
            await self._anew(lambda session: session.begin_in(run, saved.run_hash))
            response.result = LoadMap.Response.RESULT_SUCCESS
        except SlamError as error:
            self._node.get_logger().warning(f"load of '{request.map_url}' refused: {error}")
            response.result = LoadMap.Response.RESULT_UNDEFINED_FAILURE
        return response

    def _survived(self, callback: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Awaitable[Any]]:
        """The callback; where it fails, the response as it was made: what leaves a callback ends the node."""

        async def survived(request: Any, response: Any) -> Any:
            try:
                answer = callback(request, response)
                return await answer if isawaitable(answer) else answer
            except Exception as error:  # noqa: BLE001  # whatever it is
                self._node.get_logger().error(f"a service failed: {type(error).__name__}: {error}")
                return response

        return survived

    async def _elsewhere(self, work: Callable[[], T]) -> T:
        """The outcome of work done in a thread of its own. SlamError where it raises anything."""
        executor = self._node.executor
        outcome: list[T] = []
        done = Future(executor=executor)

        def run() -> None:
            failure: SlamError | None = None
            try:
                outcome.append(work())
            except SlamError as error:
                failure = error
            except Exception as error:  # noqa: BLE001  # out of a callback it would end the node
                failure = SlamError(f"failed: {type(error).__name__}: {error}")
            done.set_result(failure)
            with suppress(InvalidHandle):  # the executor may be gone
                executor.wake()

        threading.Thread(target=run, name="service", daemon=True).start()
        failure = await done
        if self._closed:
            await Future()  # for ever: the service is gone, and nobody can be answered
        if failure is not None:
            raise failure
        return outcome[0]


def _then(stamp: int) -> str:
    return f"{PAST}{format_stamp(stamp)}/pose@now"


def _told(
    act: Callable[[], Awaitable[Content]],
) -> Callable[[Any, Trigger.Response], Awaitable[Trigger.Response]]:
    """A Trigger's callback: the outcome as JSON."""

    async def callback(_: Any, response: Trigger.Response) -> Trigger.Response:
        try:
            response.message, response.success = json.dumps(await act()), True
        except SlamError as error:
            response.message = json.dumps({"error": str(error)})
        return response

    return callback


def _may_be_known_by_now(value: Value) -> bool:
    """A place on the earth that an older snapshot did not know yet."""
    return isinstance(value, Mapping) and "map_T_earth" in value and value["map_T_earth"] is None


def _parameter(value: Value) -> ParameterValue:
    """NOT_SET for what is unknown."""
    if value is None:
        return ParameterValue()
    if isinstance(value, int):
        return ParameterValue(type=ParameterType.PARAMETER_INTEGER, integer_value=value)
    if isinstance(value, Mapping):
        return ParameterValue(type=ParameterType.PARAMETER_STRING, string_value=json.dumps(value))
    return ParameterValue(
        type=ParameterType.PARAMETER_DOUBLE_ARRAY, double_array_value=value.ravel().tolist()
    )
