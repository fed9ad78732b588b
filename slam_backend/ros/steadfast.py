"""A lifecycle node that cannot be brought down: neither by a transition that is not legal, nor by what goes wrong in one, or in a callback."""

from collections.abc import Callable
from functools import wraps
from typing import Any

from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn

from ..core.errors import SlamError

Transition = Callable[[Any, LifecycleState], TransitionCallbackReturn]


class SteadfastNode(LifecycleNode):
    """incident and close are those of the node that it becomes."""

    def incident(self, what: str) -> None:
        """Something went wrong: say so. From any thread."""
        self.get_logger().error(what)

    def close(self) -> None:
        """Let go of everything. Safe to call twice."""

    def _LifecycleNodeMixin__on_change_state(self, request: Any, response: Any) -> Any:  # noqa: N802
        """A transition that is not legal here is answered, not died of: rclpy raises it out of spin."""
        try:
            return super()._LifecycleNodeMixin__on_change_state(request, response)
        except Exception as error:  # noqa: BLE001  # RCLError is no public class
            self.get_logger().warning(f"transition refused: {str(error).splitlines()[0]}")
            response.success = False
            return response


def explained(transition: Transition) -> Transition:
    """Rclpy swallows what a transition raises; say it, let go of everything, and fail."""

    @wraps(transition)
    def wrapped(node: SteadfastNode, state: LifecycleState) -> TransitionCallbackReturn:
        try:
            return transition(node, state)
        except SlamError as error:
            node.get_logger().error(str(error))
        except Exception as error:  # noqa: BLE001  # whatever it is, it must be said
            node.get_logger().error(f"{transition.__name__}: {type(error).__name__}: {error}")
        if transition.__name__ == "on_configure":
            node.close()
        return TransitionCallbackReturn.FAILURE

    return wrapped


def survived(callback: Callable[..., None]) -> Callable[..., None]:
    """What leaves a callback would end the node: it becomes an incident."""

    @wraps(callback)
    def wrapped(node: SteadfastNode, *arguments: Any) -> None:
        try:
            callback(node, *arguments)
        except Exception as error:  # noqa: BLE001  # whatever it is
            what = " ".join(str(error).split())
            node.incident(f"{callback.__name__.strip('_')} failed: {type(error).__name__}: {what}")

    return wrapped
