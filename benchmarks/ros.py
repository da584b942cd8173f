"""The time from a pose in ROS 2 to its image, through the node, beside the same over a gRPC stream; on the demo scene.

    python benchmarks/ros.py

One pose after another, as a loop that waits for each image; service, node and this program share the machine. Needs
rclpy, which `make test-ros` installs.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from measuring import write
from ultragray.phantom.demo import copy_demo_scene, demo_poses
from ultragray_client import Client, RenderSettings
from ultragray_studies.bench.report import measured
from ultragray_studies.bench.served import running_server

SCENE = "demo"
SIDES = (256, 512)
FRAMES, UNCOUNTED, ROUNDS = 200, 20, 3
TIMEOUT_S = 60.0
SURROUNDINGS = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "ROS_DOMAIN_ID": "88"}

Row = dict[str, Any]
Ask = Callable[[int], None]  # of a frame by the number of its pose, until it is there


def main() -> None:
    os.environ.update(SURROUNDINGS)
    threads = os.cpu_count() or 1
    rows: list[Row] = []
    with tempfile.TemporaryDirectory(prefix="ultragray-bench-") as folder:
        copy_demo_scene(Path(folder) / f"{SCENE}.ugr")
        with running_server(Path(folder), "cpu", SCENE) as server:
            address = f"127.0.0.1:{server.grpc_port}"
            for side in SIDES:
                with over_grpc(address, side) as grpc, over_ros(address, side) as ros:
                    ways = {"gRPC stream": grpc, "ROS 2 node": ros}
                    took_ms: dict[str, list[float]] = {way: [] for way in ways}
                    for way in list(ways) * ROUNDS:  # in turn, so that a busy minute is not one way's
                        took_ms[way] += times_ms(ways[way])
                rows += [row(side, way, times) for way, times in took_ms.items()]
    document = {"measured": measured(threads), "frames": FRAMES, "rounds": ROUNDS, "rows": rows}
    write("ros", document)


def times_ms(ask: Ask) -> list[float]:
    """The time of each frame, one after another."""
    took_ms = []
    for number in range(UNCOUNTED + FRAMES):
        began = time.perf_counter()
        ask(number)
        took_ms.append(1000.0 * (time.perf_counter() - began))
    return took_ms[UNCOUNTED:]


@contextmanager
def over_grpc(address: str, side: int) -> Iterator[Ask]:
    """The client's stream, as the node uses it."""
    poses = demo_poses(UNCOUNTED + FRAMES)
    with Client(address) as client, client.stream(SCENE, RenderSettings(height=side, width=side), mode="latest") as own:

        def ask(number: int) -> None:
            own.send(poses[number % len(poses)])
            own.receive()

        yield ask


@contextmanager
def over_ros(address: str, side: int) -> Iterator[Ask]:
    """A publisher of poses and a subscriber of images, with the node in a process of its own."""
    import rclpy
    from geometry_msgs.msg import PoseStamped
    from rclpy.qos import qos_profile_sensor_data
    from sensor_msgs.msg import Image

    rclpy.init()
    peer = rclpy.create_node("bench")
    images: list[int] = []
    peer.create_subscription(
        Image, "/ultragray/bmode", lambda image: images.append(image.header.stamp.sec), qos_profile_sensor_data
    )
    publisher = peer.create_publisher(PoseStamped, "/ultragray/probe_pose", qos_profile_sensor_data)
    parameters = (f"address:={address}", f"scene:={SCENE}", f"height:={side}", f"width:={side}")
    options = [part for parameter in parameters for part in ("-p", parameter)]
    command = [sys.executable, "-m", "ultragray_ros.node", "--ros-args", *options]
    with subprocess.Popen(command, stdin=subprocess.DEVNULL) as node:
        try:
            ask = partial(_ask, rclpy, peer, publisher, images, demo_poses(UNCOUNTED + FRAMES))
            ask(0)
            yield ask
        finally:
            node.terminate()
            peer.destroy_node()
            rclpy.shutdown()


def _ask(rclpy: Any, peer: Any, publisher: Any, images: list[int], poses: Any, number: int) -> None:
    """Publish a pose, and again each second until its image is there: the first ones find no node yet."""
    from geometry_msgs.msg import PoseStamped

    pose = PoseStamped()
    pose.header.stamp.sec = number
    place = pose.pose.position
    place.x, place.y, place.z = (poses[number % len(poses)][:3, 3] / 1000.0).tolist()
    images.clear()
    began = time.monotonic()
    while number not in images:
        publisher.publish(pose)
        sent_s = time.monotonic()
        while number not in images and time.monotonic() - sent_s < 1.0:
            rclpy.spin_once(peer, timeout_sec=0.1)
        if time.monotonic() - began > TIMEOUT_S:
            raise TimeoutError(f"no image for pose {number} within {TIMEOUT_S:g} s")


def row(side: int, way: str, took_ms: list[float]) -> Row:
    """Percentiles over all rounds."""
    p50_ms, p99_ms = np.percentile(took_ms, (50, 99)).tolist()
    return {"side": side, "way": way, "p50_ms": p50_ms, "p99_ms": p99_ms}


if __name__ == "__main__":
    main()
