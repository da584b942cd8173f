"""Writes a page of the demo scene and random frames of it as the reference renders them.

`make_frames.py FOLDER COUNT SEED`: beside the page, demo.ugr, its scene before that was compressed, requests.json (pose
and settings of each, and by how much its display settings enlarge a difference) and expected.bin, the float32 of all,
one after another.
"""

import json
import sys
from pathlib import Path

import numpy as np

from ultragray import GaussianScene
from ultragray.contract import from_dict, to_dict
from ultragray.exchange.page import write_page
from ultragray.geometry.probe import Probe
from ultragray.geometry.rotations import random_directions, rotations_of
from ultragray.phantom.demo import DEMO_FILE, copy_demo_scene
from ultragray.rendering.display import FRAME_RANGE_DB
from ultragray.rendering.frames import render_shown
from ultragray.rendering.settings import RenderSettings

NEEDLE = {"kind": "needle", "frame": "probe", "tip_mm": [8.0, 0.3, 30.0], "hub_mm": [-20.0, 0.0, 5.0]}
OUTPUTS = ("bmode", "echo", "transmittance", "coverage")


def random_settings(random):
    settings = {"encoding": "float32", "height": int(random.integers(1, 120)), "width": int(random.integers(1, 120))}
    settings["outputs"] = [str(one) for one in random.choice(OUTPUTS, size=random.integers(1, 4), replace=False)]
    if random.random() < 0.6:
        settings["probe"] = (
            to_dict(random.choice([*Probe.named.values()])) if random.random() < 0.5 else random_probe(random)
        )
    if random.random() < 0.3:
        settings["slice_thickness_mm"] = float(random.uniform(0.0, 4.0))
    if random.random() < 0.3:
        settings["tools"] = [
            {"kind": "needle", "frame": "probe", "tip_mm": [8.0, 0.3, 30.0], "hub_mm": [-20.0, 0.0, 5.0]}
        ]
    if random.random() < 0.2:
        settings["ghost"] = float(random.uniform(0.1, 1.0))
    if random.random() < 0.5:
        display = {"gain_db": float(random.uniform(-10, 10)), "dynamic_range_db": float(random.uniform(30, 90))}
        display["flip"] = bool(random.random() < 0.5)
        display["edge"] = float(random.uniform(0, 2)) if random.random() < 0.5 else 0.0
        display["tgc_db"] = random.uniform(-6, 6, size=random.integers(0, 5)).tolist()
        settings["display"] = display
    return settings


def random_probe(random):
    near, length = float(random.uniform(0.0, 5.0)), float(random.uniform(10.0, 60.0))
    return {
        0: {"kind": "linear", "width_mm": 40.0, "near_mm": near, "far_mm": near + length},
        1: {"kind": "steered", "width_mm": 40.0, "steering_deg": 25.0, "near_mm": near, "far_mm": near + length},
        2: {"kind": "convex", "opening_angle_deg": 80.0, "near_mm": near + 20.0, "far_mm": near + length + 20.0},
        3: {"kind": "phased", "opening_angle_deg": 90.0, "far_mm": near + length},
        4: {"kind": "radial", "near_mm": near + 1.0, "far_mm": near + length},
    }[int(random.integers(5))]


def main(folder, count, seed):
    random = np.random.default_rng(seed)
    write_page(DEMO_FILE, folder)
    copy_demo_scene(folder / "demo.ugr")
    scene = GaussianScene.load(folder / "scene.ugz")
    requests = []
    with (folder / "expected.bin").open("wb") as expected:
        for _ in range(count):
            pose = scene.training_poses[random.integers(len(scene.training_poses))].copy()
            pose[:3, :3] = pose[:3, :3] @ rotations_of(0.3 * random.normal() * random_directions(random, 1))[0]
            pose[:3, 3] += random.normal(scale=5.0, size=3)
            settings = random_settings(random)
            asked = from_dict(RenderSettings, settings)
            resolved = asked.resolved(scene.info, asked.encoding)
            shown = render_shown(scene, resolved, pose[None], backend="reference")
            for name in resolved.outputs:
                expected.write(shown[name].numpy().astype("<f4").tobytes())
            display = resolved.display
            enlarged = max(1.0, FRAME_RANGE_DB / display.dynamic_range_db) * (1.0 + 2.0 * display.edge)
            requests.append({"pose": pose.ravel().tolist(), "settings": settings, "enlarged": enlarged})
    (folder / "requests.json").write_text(json.dumps(requests))


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]))
