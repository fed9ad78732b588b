"""~/get_trajectory, served by a process of its own: an answer of 10,000 poses would stop the node's callbacks for long.

The process has a context and a node of its own. Asked for a trajectory, it asks the node's process for the newest
snapshot over a pipe; there a thread answers, with arrays that are written as they lie in memory.
"""

import math
import multiprocessing
import pickle
import signal
import threading
from collections.abc import Callable
from contextlib import suppress
from itertools import count
from multiprocessing.connection import Connection

import numpy as np
import rclpy
from geometry_msgs.msg import PoseStamped
from nav_msgs.srv import GetPlan
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future

from ..core.errors import BadMessage, SlamError
from ..core.measurement import SECOND, Array, parse_stamp, stamp_of
from ..core.trajectory import Snapshot, Stamps

MOST = 50_000  # resampled poses in one answer
PATIENCE = 0.2  # s between two looks at whether to stop
PAUSE = 1.0  # s before a process that ended is started anew
FAREWELL = 1.0  # s that the process may take to leave the network
Believe = Callable[[int | None], Snapshot | None]


class Answers:
    """Keeps the process alive and gives it snapshots.

    service: its full name. frame: the frame of the trajectory. believed: called for each request, with the stamp of an earlier
    belief (ns; None: the newest), in a thread of its own if it is an earlier one; may take a while. log: told in words when the
    process was lost.
    """

    def __init__(
        self, service: str, namespace: str, frame: str, believed: Believe, log: Callable[[str], object]
    ) -> None:
        self._arguments = (service, namespace, frame)
        self._believed, self._log = believed, log
        self._sending = threading.Lock()
        self._stop = threading.Event()
        self._start()
        self._thread = threading.Thread(target=self._keep, name="answers", daemon=True)
        self._thread.start()

    @property
    def pid(self) -> int | None:
        return self._process.pid

    def close(self) -> None:
        """End the process; safe to call twice."""
        self._stop.set()
        self._thread.join()
        self._process.join(FAREWELL)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()

    def _start(self) -> None:
        context = multiprocessing.get_context("spawn")  # a forked copy of DDS's threads would deadlock
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(target=serve, args=(theirs, *self._arguments), daemon=True)
        self._process.start()
        theirs.close()

    def _keep(self) -> None:
        """Until told to stop: answer the process, and start another one where it ended."""
        while True:
            try:
                while not self._stop.is_set():
                    if self._pipe.poll(PATIENCE):
                        asked: tuple[int, int | None] = self._pipe.recv()
                        if asked[1] is None:
                            self._tell(self._pipe, *asked)
                        else:  # others are answered meanwhile
                            arguments = (self._pipe, *asked)
                            threading.Thread(target=self._tell, args=arguments, daemon=True).start()
            except (EOFError, OSError):
                pass
            self._pipe.close()  # by which the process knows its end
            if self._stop.wait(PAUSE):
                return
            self._process.join()
            self._log(
                f"the process of get_trajectory ended with code {self._process.exitcode}; another one starts"
            )
            self._start()

    def _tell(self, pipe: Connection, request: int, stamp: int | None) -> None:
        try:
            found: Snapshot | str | None = self._believed(stamp)
        except SlamError as error:
            found = str(error)
        with self._sending, suppress(OSError):  # the process may be gone: then so is its request
            _send(pipe, request, found)


def _send(pipe: Connection, request: int, found: Snapshot | str | None) -> None:
    """Arrays beside the pickle: they are written without a copy, and without the GIL."""
    buffers: list[pickle.PickleBuffer] = []
    head = pickle.dumps(found, protocol=5, buffer_callback=buffers.append)
    pipe.send((request, head, len(buffers)))
    for buffer in buffers:
        pipe.send_bytes(buffer.raw())


def _receive(pipe: Connection) -> tuple[int, Snapshot | str | None]:
    """The number of the request, and a snapshot, or why there is none."""
    request, head, count = pipe.recv()
    return request, pickle.loads(head, buffers=[pipe.recv_bytes() for _ in range(count)])  # noqa: S301  # our own process


# -- in the process ----------------------------------------------------------------------------------


def selected(snapshot: Snapshot | None, start: int, goal: int, period: float) -> tuple[Stamps, Array]:
    """(N,) stamps and (N, 7) `map_T_base` from `start` to `goal` (ns; 0: open), both included.

    period: 0 for the keyframes, else s between poses, in the shape of the odometry. BadMessage if it cannot be.
    """
    if not (period >= 0 and math.isfinite(period)):
        raise BadMessage(f"tolerance is the resample period in seconds: {period:g} is none")
    if snapshot is None or not len(snapshot.trajectory):
        return np.zeros(0, dtype=np.int64), np.zeros((0, 7))
    stamps = snapshot.stamps
    first, last = max(start, int(stamps[0])), min(goal or int(stamps[-1]), int(stamps[-1]))
    if period == 0:
        rows = slice(np.searchsorted(stamps, first), np.searchsorted(stamps, last, side="right"))
        return stamps[rows], snapshot.trajectory.sevens[rows]
    step = max(round(period * SECOND), 1)
    if (last - first) // step >= MOST:
        raise BadMessage(f"a period of {period:g} s makes more than {MOST:,} poses; ask for less")
    wanted = np.arange(first, last + 1, step, dtype=np.int64)
    wanted = wanted[~snapshot.trajectory.between_sessions(wanted)]
    return wanted, snapshot.at(wanted)


def asked_belief(asked: str, frame: str) -> int | None:
    """The stamp (ns) in `<frame>@<t>`; None for the newest belief. BadMessage for anything else."""
    name, at, when = asked.partition("@")
    if name not in ("", frame) or (at and not name):
        raise BadMessage(f"'{asked}' is not the frame of the trajectory, which is '{frame}'")
    if not at or when == "now":
        return None
    try:
        return parse_stamp(when)
    except ValueError as error:
        raise BadMessage(f"'{asked}': {error}") from None


class Server:
    """Answers requests with what the node's process knows."""

    def __init__(
        self, pipe: Connection, frame: str, warn: Callable[[str], object], executor: SingleThreadedExecutor
    ) -> None:
        self._pipe, self._frame, self._warn, self._executor = pipe, frame, warn, executor
        self._asked: dict[int, Future] = {}
        self._numbers = count(1)
        self._pool: list[PoseStamped] = []

    def listen(self) -> None:
        """Until the node is gone."""
        try:
            while True:
                request, found = _receive(self._pipe)
                self._asked.pop(request).set_result(found)
                self._executor.wake()
        except (EOFError, OSError):
            pass

    async def answer(self, request: GetPlan.Request, response: GetPlan.Response) -> GetPlan.Response:
        response.plan.header.frame_id = self._frame
        try:
            stamps, sevens = await self._selected(request)
        except BadMessage as error:
            self._warn(f"get_trajectory answers nothing: {error}")
            return response
        response.plan.poses = self._filled(stamps, sevens)
        if len(stamps):
            response.plan.header.stamp = response.plan.poses[-1].header.stamp
        return response

    async def _selected(self, request: GetPlan.Request) -> tuple[Stamps, Array]:
        stamp = asked_belief(request.start.header.frame_id, self._frame)
        period = float(str(np.float32(request.tolerance)))  # 0.1 as it was meant, not 0.10000000149
        number, answered = next(self._numbers), Future(executor=self._executor)
        self._asked[number] = answered
        self._pipe.send((number, stamp))
        found = await answered
        if isinstance(found, str):
            raise BadMessage(found)
        return selected(found, stamp_of(request.start), stamp_of(request.goal), period)

    def _filled(self, stamps: Stamps, sevens: Array) -> list[PoseStamped]:
        """The poses, in objects that are reused: to fill one is several times faster than to make it."""
        for _ in range(len(stamps) - len(self._pool)):
            new = PoseStamped()
            new.header.frame_id = self._frame
            self._pool.append(new)
        poses = self._pool[: len(stamps)]
        seconds, nanoseconds = (part.tolist() for part in np.divmod(stamps, SECOND))
        for pose, sec, nanosec, seven in zip(poses, seconds, nanoseconds, sevens.tolist(), strict=True):
            stamp, position, orientation = pose.header.stamp, pose.pose.position, pose.pose.orientation
            stamp.sec, stamp.nanosec = sec, nanosec
            position.x, position.y, position.z = seven[:3]
            orientation.x, orientation.y, orientation.z, orientation.w = seven[3:]
        return poses


def serve(pipe: Connection, service: str, namespace: str, frame: str) -> None:
    """The process: answers until the node's end of the pipe is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the node's affair: the pipe will tell
    context = rclpy.Context()
    rclpy.init(context=context, signal_handler_options=SignalHandlerOptions.NO)
    name = "_" + service.strip("/").replace("/", "_")  # of its own, and hidden by the underscore
    node = Node(
        name, namespace=namespace, context=context, use_global_arguments=False, start_parameter_services=False
    )
    executor = SingleThreadedExecutor(context=context)
    server = Server(pipe, frame, node.get_logger().warning, executor)
    node.create_service(GetPlan, service, server.answer, callback_group=ReentrantCallbackGroup())

    def listen() -> None:
        server.listen()
        context.try_shutdown()

    executor.add_node(node)
    threading.Thread(target=listen, name="listen", daemon=True).start()  # it may be told at once to end
    with suppress(ExternalShutdownException):
        executor.spin()
