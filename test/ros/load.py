"""Sends and hears at a robot's rates, and says how long ~/odometry takes: `load.py send HZ SECONDS LOOPS_PER_S` or `load.py hear TOPIC`.

send: odometry on a circle of 20 m, stamped when it is published, and loops to the first round; says `sent N odometry M loops`.
hear: at its end one line of JSON: [stamp in ns, latency in ms] of each message.
"""

import json
import sys
import time
from math import cos, sin
from struct import unpack_from

import numpy as np
import rclpy
from nav_msgs.msg import Odometry
from rclpy.executors import ExternalShutdownException
from rclpy.qos import QoSProfile

from slam_backend.core.measurement import format_stamp
from slam_backend.io.encode import encode_odometry

ZEROS = np.zeros(36), np.zeros(6), np.zeros(36)
ROUND = 500  # odometry messages


def on_circle(n):
    a = n * 2 * np.pi / ROUND
    return 20 * sin(a), 20 - 20 * cos(a), 0.0, 0.0, 0.0, sin(a / 2), cos(a / 2)


def send(hz, seconds, loops):
    node = rclpy.create_node("load")
    profile = QoSProfile(depth=2000)
    odometry, closures = (node.create_publisher(Odometry, topic, profile) for topic in ("/odom", "/loops"))
    while not (odometry.get_subscription_count() and closures.get_subscription_count()):
        time.sleep(0.01)
    time.sleep(0.5)
    sys.stdout.write("matched\n")
    sys.stdout.flush()
    stamps, told, begin = [], 0, time.monotonic()
    for n in range(int(hz * seconds)):
        if (left := begin + n / hz - time.monotonic()) > 0:
            time.sleep(left)
        stamps.append(time.time_ns())
        odometry.publish(encode_odometry(stamps[-1], "odom", "base", on_circle(n), *ZEROS))
        if n >= 2 * ROUND and n * loops // hz > (n - 1) * loops // hz:
            old = n % ROUND
            frames = (f"base@{format_stamp(stamps[k])}" for k in (old, n - hz // 5))
            pose = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0) if hz // 5 == 0 else relative(old, n - hz // 5)
            closures.publish(encode_odometry(time.time_ns(), *frames, pose, *ZEROS))
            told += 1
    for publisher in (odometry, closures):
        publisher.wait_for_all_acked()
    sys.stdout.write(f"sent {len(stamps)} odometry {told} loops in {time.monotonic() - begin:.1f} s\n")


def relative(i, j):
    """Pose of the j-th in the i-th."""
    (xi, yi, *_), (xj, yj, *_) = on_circle(i), on_circle(j)
    a, b = (k * 2 * np.pi / ROUND for k in (i, j))
    dx, dy, half = xj - xi, yj - yi, (b - a) / 2
    return cos(a) * dx + sin(a) * dy, cos(a) * dy - sin(a) * dx, 0.0, 0.0, 0.0, sin(half), cos(half)


def hear(topic):
    node, heard = rclpy.create_node("hear"), []

    def take(data):
        now = time.time_ns()
        seconds, nanoseconds = unpack_from("<iI", data, 4)
        stamp = seconds * 1_000_000_000 + nanoseconds
        heard.append((stamp, (now - stamp) / 1e6))

    node.create_subscription(Odometry, topic, take, QoSProfile(depth=2000), raw=True)
    sys.stdout.write("ready\n")
    sys.stdout.flush()
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        rclpy.try_shutdown()
    sys.stdout.write(json.dumps(heard) + "\n")


rclpy.init()
if sys.argv[1] == "send":
    send(int(sys.argv[2]), float(sys.argv[3]), float(sys.argv[4]))
else:
    hear(sys.argv[2])
