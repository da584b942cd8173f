"""The layout for Foxglove: its panels show what there is."""

import json
import re

import numpy as np
from mcap.reader import make_reader

from ultragray.exchange.ros_recording import RosRecording

from ..surroundings import ROOT

LAYOUT = json.loads((ROOT / "ros/foxglove/ultragray.json").read_text())


def panels(tree):
    return [tree] if isinstance(tree, str) else [*panels(tree["first"]), *panels(tree["second"])]


def test_every_panel_has_its_place():
    assert sorted(panels(LAYOUT["layout"])) == sorted(LAYOUT["configById"])


def test_panels_show_the_topics_of_recordings_which_are_those_of_the_node(tmp_path):
    images = {"bmode": np.zeros((4, 5), np.uint8), "labels": np.ones((4, 5), np.uint8)}
    picture = {"height": 4, "width": 5, "column_unit": "mm", "first": (0.0, 0.0), "step": (1.0, 1.0)}
    origin = {"scene": "demo", "scene_sha256": "0" * 64, "picture": picture}
    with (tmp_path / "frames.mcap").open("wb+") as file:
        recording = RosRecording(file)
        recording.add(images, np.eye(4), {"confidence": 0.5}, origin, 0)
        recording.finish()
        file.seek(0)
        recorded = {channel.topic: schema.name for schema, channel, _ in make_reader(file).iter_messages()}
    shown = set(re.findall(r"/ultragray/\w+", json.dumps(LAYOUT)))
    assert shown <= set(recorded)
    image = LAYOUT["configById"]["Image!bmode"]["imageMode"]
    assert recorded[image["imageTopic"]] == "sensor_msgs/msg/Image"
    assert [recorded[topic] for topic in image["annotations"]] == ["foxglove_msgs/msg/ImageAnnotations"]
    published = LAYOUT["configById"]["Publish!pose"]
    assert recorded[published["topicName"]] == published["datatype"]
    assert set(json.loads(published["value"])) == {"header", "pose"}
