"""What a robot and its clients do to a node, each as a process of its own:

`load.py send RADIUS [at_once]`: for each line `HZ SPEED SECONDS LOOPS_PER_S` on its input, odometry of a drive on a circle, stamped when it is
published, and loops with the round before. Says `matched` when the node listens, or at once, and `sent N odometry M loops` after each line.
`load.py watch`: says `queue N keyframes K` as often as the diagnostics do.
`load.py hear TOPIC TYPE`: says `ready`, `first AT`, and at its end one line of JSON: [stamp in ns, latency in ms] of each message.
`load.py ask get_trajectory|query SECONDS`: again and again; then one line of JSON: [number of values in the answer, seconds] of each.
`load.py draw POSES TIMES`: ~/path of so many poses; one line of JSON: milliseconds to build and publish each.
"""

import json
import sys
import time
from bisect import bisect_left
from contextlib import suppress
from importlib import import_module
from math import cos, pi, sin
from struct import unpack_from

import numpy as np
import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.qos import QoSProfile

from slam_backend.core.measurement import SECOND, format_stamp
from slam_backend.io.encode import encode_odometry

ODOMETRY = "nav_msgs/msg/Odometry"
ZEROS = np.zeros(36), np.zeros(6), np.zeros(36)
DEPTH = 10_000  # of its queues: what is lost is not lost by the sender
DRIFT = 1.01  # radius that odometry sees, over the true one
LATE = 0.2  # s from a keyframe to the loop that was found there
MATCHING = 0.5  # s until both ends of a connection know of each other


def class_of(type_):
    package, kind, name = type_.split("/")
    return getattr(import_module(f"{package}.{kind}"), name)


def say(line):
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


def wait_until(condition):
    while not condition():
        time.sleep(0.01)
    time.sleep(MATCHING)


# -- send --------------------------------------------------------------------------------------------


def on_circle(arc, radius):
    """The pose after `arc` metres: x y z qx qy qz qw."""
    a = arc / radius
    return radius * sin(a), radius - radius * cos(a), 0.0, 0.0, 0.0, sin(a / 2), cos(a / 2)


def relative(i, j, radius):
    """Pose at arc j in that at arc i."""
    return on_circle(j - i, radius)  # a circle is the same from everywhere


class Drive:
    def __init__(self, radius):
        self.radius, self.stamps, self.arcs = radius, [], []
        node, profile = rclpy.create_node("load"), QoSProfile(depth=DEPTH)
        self.odometry, self.loops = (
            node.create_publisher(class_of(ODOMETRY), topic, profile) for topic in ("/odom", "/loops")
        )

    def wait(self):
        wait_until(lambda: self.odometry.get_subscription_count() and self.loops.get_subscription_count())

    def go(self, hz, speed, seconds, loops):
        begin, arc, told = time.monotonic(), self.arcs[-1] if self.arcs else 0.0, 0
        count = round(hz * seconds)
        for n in range(count):
            if (left := begin + n / hz - time.monotonic()) > 0:
                time.sleep(left)
            arc += speed / hz
            self.arcs.append(arc)
            self.stamps.append(time.time_ns())
            pose = on_circle(arc, self.radius * DRIFT)
            self.odometry.publish(encode_odometry(self.stamps[-1], "odom", "base", pose, *ZEROS))
            if int(n * loops / hz) > int((n - 1) * loops / hz):
                told += self.close_loop(len(self.arcs) - 1 - round(hz * LATE))
        for publisher in (self.odometry, self.loops):
            publisher.wait_for_all_acked()
        say(f"sent {count} odometry {told} loops in {time.monotonic() - begin:.1f} s")

    def close_loop(self, j):
        """With where the robot was a round before."""
        before = self.arcs[max(j, 0)] - 2 * pi * self.radius
        if before < self.arcs[0]:
            return False
        i = bisect_left(self.arcs, before)
        frames = (f"base@{format_stamp(self.stamps[k])}" for k in (i, j))
        pose = relative(self.arcs[i], self.arcs[j], self.radius)
        self.loops.publish(encode_odometry(time.time_ns(), *frames, pose, *ZEROS))
        return True


def send(radius, at_once=""):
    drive = Drive(float(radius))
    if not at_once:
        drive.wait()
    say("matched")
    for line in sys.stdin:
        drive.go(*map(float, line.split()))


# -- watch, hear, ask, draw ---------------------------------------------------------------------------------


def hear(topic, type_):
    node, heard = rclpy.create_node("hear"), []

    def take(data):
        now = time.time_ns()
        seconds, nanoseconds = unpack_from("<iI", data, 4)
        stamp = seconds * SECOND + nanoseconds
        if not heard:
            say(f"first {now / 1e9:.3f}")
        heard.append((stamp, (now - stamp) / 1e6))

    node.create_subscription(class_of(type_), topic, take, QoSProfile(depth=DEPTH), raw=True)
    say("ready")
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        rclpy.try_shutdown()
    say(json.dumps(heard))


def watch():
    node = rclpy.create_node("watch")

    def take(message):
        (values,) = (status.values for status in message.status if status.name == "slam_backend: solver")
        told = {value.key: value.value for value in values}
        say(f"queue {told.get('queue')} keyframes {told.get('keyframes')}")

    node.create_subscription(class_of("diagnostic_msgs/msg/DiagnosticArray"), "/diagnostics", take, 10)
    with suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(node)


def ask(service, seconds):
    from nav_msgs.srv import GetPlan
    from rcl_interfaces.srv import GetParameters

    requests = {"get_trajectory": GetPlan.Request(), "query": GetParameters.Request(names=["pose@k10"])}
    request = requests[service]
    node = rclpy.create_node("ask")
    client = node.create_client(
        GetPlan if service == "get_trajectory" else GetParameters, f"/slam_backend/{service}"
    )
    wait_until(client.service_is_ready)
    took, end = [], time.monotonic() + float(seconds)
    while time.monotonic() < end:
        begin = time.monotonic()
        future = client.call_async(request)
        rclpy.spin_until_future_complete(node, future, timeout_sec=20)
        answer = future.result()
        count = len(answer.plan.poses if service == "get_trajectory" else answer.values[0].double_array_value)
        took.append((count, time.monotonic() - begin))
    say(json.dumps(took))


def draw(poses, times):
    from slam_backend.core.config import Config, PathOutput
    from slam_backend.core.trajectory import Snapshot, Trajectory
    from slam_backend.ros.outputs import Outputs

    n = np.arange(int(poses))
    way = Trajectory(n * SECOND, np.array([on_circle(0.5 * k, 100.0) for k in n.tolist()]))
    snapshot = Snapshot(way, n, way, (), np.zeros((0, 3)), 1)
    node = rclpy.create_node("draw")
    outputs, took = Outputs(node, Config(path=PathOutput(poses=int(poses)))), []
    wait_until(lambda: outputs.has_listeners("path"))
    for _ in range(int(times)):
        begin = time.perf_counter()
        outputs.path(snapshot)
        took.append(1e3 * (time.perf_counter() - begin))
        time.sleep(0.1)
    say(json.dumps(took))


if __name__ == "__main__":
    rclpy.init()
    {"send": send, "watch": watch, "hear": hear, "ask": ask, "draw": draw}[sys.argv[1]](*sys.argv[2:])
