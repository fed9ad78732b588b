"""Says what it hears: `listener.py TOPIC TYPE QOS ...`, where QOS is `volatile` or `latched`, or `raw` for sizes only.

One line per message: the topic, and the fields as rclpy reads them, as JSON. Says `ready` once it has subscribed to all.
"""

import array
import json
import sys
from importlib import import_module

import numpy as np
import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy


def plain(value):
    """A message as dicts, lists and numbers; bytes as hex."""
    if hasattr(value, "get_fields_and_field_types"):
        return {name: plain(getattr(value, name)) for name in value.get_fields_and_field_types()}
    if isinstance(value, (bytes, array.array)) and getattr(value, "typecode", "B") == "B":
        return bytes(value).hex()
    if isinstance(value, (np.ndarray, array.array)):
        return value.tolist()
    return [plain(item) for item in value] if isinstance(value, (list, tuple)) else value


def listen(node, topic, type_, qos):
    package, _, name = type_.split("/")
    durability = DurabilityPolicy.TRANSIENT_LOCAL if qos == "latched" else DurabilityPolicy.VOLATILE
    profile = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE, durability=durability)

    def heard(message):
        told = len(message) if qos == "raw" else json.dumps(plain(message))
        sys.stdout.write(f"{topic} {told}\n")

    message_class = getattr(import_module(f"{package}.msg"), name)
    node.create_subscription(message_class, topic, heard, profile, raw=qos == "raw")


def main():
    rclpy.init()
    node = rclpy.create_node("listener")
    for at in range(1, len(sys.argv), 3):
        listen(node, *sys.argv[at : at + 3])
    sys.stdout.write("ready\n")
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        rclpy.try_shutdown()


main()
