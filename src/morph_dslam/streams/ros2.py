"""A stream to ROS 2, by rclpy: topics of standard messages, made only for those that somebody subscribes to."""

from __future__ import annotations

import array
import threading
from importlib import import_module
from typing import Any

import numpy as np
import rclpy  # pyright: ignore[reportMissingImports]
from numpy.typing import NDArray

from morph_dslam.sources.live import Newest
from morph_dslam.streams.messages import FrameMessage, SceneMessage
from morph_dslam.streams.ros2_messages import Topic, build, topics

#: Messages that wait for a subscriber.
DEPTH = 10


class RosPublisher:
    """Publishes frames from a thread of its own, always the newest.

    Parameters
    ----------
    prefix : of the topics.
    """

    def __init__(self, prefix: str) -> None:
        self._prefix = prefix
        self._begun = not rclpy.ok()  # else this program is part of another one that began ROS
        if self._begun:
            rclpy.init()
        self._node = rclpy.create_node("morph")
        self._topics: dict[str, tuple[Topic, Any]] = {}
        self._newest: Newest[FrameMessage] = Newest()
        self._thread = threading.Thread(target=self._publish_all, name="ROS 2", daemon=True)
        self._thread.start()

    @property
    def place(self) -> str:
        """The topics."""
        return f"ROS 2 topics {self._prefix}/..., /tf and /diagnostics"

    @property
    def is_watched(self) -> bool:
        """Whether anybody subscribes to a topic."""
        return any(publisher.get_subscription_count() for _, publisher in self._topics.values())

    def begin(self, scene: SceneMessage) -> None:
        """Advertise the topics of a scene."""
        for _, publisher in self._topics.values():
            self._node.destroy_publisher(publisher)
        self._topics = {
            name: (topic, self._node.create_publisher(_class_of(topic.type), name, DEPTH))
            for name, topic in topics(scene, self._prefix).items()
        }

    def publish(self, message: FrameMessage) -> None:
        """Hand a frame to the thread; one that it had no time for is dropped."""
        self._newest.put(message)

    def close(self) -> None:
        """Publish what is left, and end the node."""
        self._newest.end()
        self._thread.join()
        self._node.destroy_node()
        if self._begun:
            rclpy.shutdown()

    def _publish_all(self) -> None:
        while (message := self._newest.take()) is not None:
            for topic, publisher in tuple(self._topics.values()):
                if publisher.get_subscription_count() and (made := topic.make(message)) is not None:
                    publisher.publish(build(made, _class_of, _numbers, _octet))


def _class_of(kind: str) -> Any:
    package, _, name = kind.split("/")
    return getattr(import_module(f"{package}.msg"), name)


def _numbers(values: NDArray) -> array.array:
    """The form of arrays that rclpy takes without looking at each number."""
    return array.array("B" if values.dtype == np.uint8 else "d", values.tobytes())


def _octet(value: int) -> bytes:
    return bytes([value])
