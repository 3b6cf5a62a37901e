"""A node that only listens, for programs that are no nodes otherwise."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial

import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from dopslam_ros.messages import topics
from dopslam_ros.nodes.middleware import middleware_class, reading_profile
from dopslam_ros.nodes.running import stay_on_this_machine


@contextmanager
def listening(
    names: Mapping[str, topics.Topic], hear: Callable[[str, bytes], None]
) -> Iterator[Callable[[float], None]]:
    """Subscribes to topics by their full names; gives a function that listens for some seconds.

    Args:
        names: the topics.
        hear: is called with the full name and the bytes of each message.
    """
    stay_on_this_machine()
    context = Context()
    rclpy.init(args=[], context=context, signal_handler_options=SignalHandlerOptions.NO)
    executor = SingleThreadedExecutor(context=context)
    node = Node(f"dopslam_listener_{os.getpid()}", context=context, enable_rosout=False)
    try:
        for name, topic in names.items():
            node.create_subscription(
                middleware_class(topic.type_name),
                name,
                partial(hear, name),
                reading_profile(topic),
                raw=True,
            )
        executor.add_node(node)
        yield lambda seconds: executor.spin_once(timeout_sec=seconds)
    finally:
        executor.shutdown()
        node.destroy_node()
        context.try_shutdown()
