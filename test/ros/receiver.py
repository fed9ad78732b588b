"""Counts what it gets, byte for byte: `receiver.py DEPTH TOPIC TYPE ...`. Says `ready`, `first of TOPIC`, and at its end one line of JSON.

The line: topic -> [number of messages, SHA-256 over their bytes in order of arrival, the first, the last (hex)].
"""

import hashlib
import json
import sys
from importlib import import_module

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.qos import DurabilityPolicy, QoSProfile


def receive(node, topic, kind, depth):
    package, _, name = kind.split("/")
    latched = topic.endswith("/tf_static")
    durability = DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE
    got = []

    def take(message):
        if not got:
            sys.stdout.write(f"first of {topic}\n")
        got.append(message)

    message_class = getattr(import_module(f"{package}.msg"), name)
    node.create_subscription(
        message_class, topic, take, QoSProfile(depth=depth, durability=durability), raw=True
    )
    return got


def main():
    rclpy.init()
    node = rclpy.create_node("receiver")
    depth, topics = int(sys.argv[1]), sys.argv[2:]
    got = {
        topic: receive(node, topic, kind, depth)
        for topic, kind in zip(topics[::2], topics[1::2], strict=True)
    }
    sys.stdout.write("ready\n")
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        rclpy.try_shutdown()
    told = {
        topic: [len(all_), hashlib.sha256(b"".join(all_)).hexdigest(), all_[0].hex(), all_[-1].hex()]
        if all_
        else [0]
        for topic, all_ in got.items()
    }
    sys.stdout.write(json.dumps(told) + "\n")


main()
