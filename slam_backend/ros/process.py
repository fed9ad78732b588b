"""The node as a process: its signals, its executor, its exit code."""

import gc
import os
import sys
from collections.abc import Sequence

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.signals import SignalHandlerOptions

from ..core.config import Config
from .node import STEADY, BackendNode
from .signals import wishes

BEAT = 0.1  # s within which a signal is heard
# Through shared memory each process that appears would stop all publishers for 0.3 s (Fast DDS issue 6535).
TRANSPORTS, OVER_UDP = "FASTDDS_BUILTIN_TRANSPORTS", "UDPv4"


def main(
    arguments: list[str] | None = None, config: Config | None = None, heard: Sequence[int] | None = None
) -> int:
    """Run the node until it is told to stop; exit code 2 with one line for a wrong configuration.

    config: what the parameters start from; ROS arguments override it. heard: the wishes to end, where they are noted already.
    """
    os.environ.setdefault(TRANSPORTS, OVER_UDP)
    heard = wishes() if heard is None else heard
    try:
        rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
        node = BackendNode(start=config)
    except Exception as error:  # noqa: BLE001  # rclpy's for malformed arguments are no public classes
        sys.stderr.write(f"slam-backend: {' '.join(str(error).split())}\n")
        rclpy.try_shutdown()
        return 2
    try:
        return _run(node, heard)
    finally:
        node.close()
        node.destroy_node()
        rclpy.try_shutdown()


def _run(node: BackendNode, heard: Sequence[int]) -> int:
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    node.create_timer(BEAT, lambda: None, clock=STEADY)  # Python hears a signal between two callbacks only
    if node.config.autostart:
        if node.trigger_configure() != TransitionCallbackReturn.SUCCESS:
            return 2  # the reason has been logged
        node.trigger_activate()
    gc.collect()
    gc.freeze()  # modules and message types: to look through them again and again would stop all threads for 50 ms each time
    while not heard and rclpy.ok():
        executor.spin_once()
    return 0
