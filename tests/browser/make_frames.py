"""Writes a page of the demo scene, and random frames of it and of two other scenes as the library renders them.

`make_frames.py FOLDER COUNT SEED`: beside the page, the scenes, demo.ugr among them, its own before that was
compressed; requests.json (scene, pose and settings of each frame, and by how much its display settings enlarge a
difference) and expected.bin, the float32 of all, one after another. The reference takes seconds for a frame: it renders
the first REFERENCE of them, the CPU's kernels the others, which the tests of the backends hold against the reference.
"""

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from ultragray import GaussianScene
from ultragray.contract import from_dict, to_dict
from ultragray.exchange.page import write_page
from ultragray.geometry.probe import Probe
from ultragray.geometry.rotations import random_directions, rotations_of
from ultragray.phantom.demo import DEMO_FILE, copy_demo_scene
from ultragray.rendering.display import FRAME_RANGE_DB
from ultragray.rendering.frames import render_shown
from ultragray.rendering.settings import RenderSettings
from ultragray.scene.info import SceneInfo

REFERENCE = 60
CLOUD = "cloud.ugr"
NEEDLE = {"kind": "needle", "frame": "probe", "tip_mm": [8.0, 0.3, 30.0], "hub_mm": [-20.0, 0.0, 5.0]}
BOX = {"kind": "box", "frame": "scene", "centre_mm": [2.0, 5.0, 25.0], "size_mm": [6.0, 40.0, 3.0], "opacity": 0.7}
OUTPUTS = ("bmode", "echo", "transmittance", "attenuation", "coverage")


def random_settings(random, *, has_speckle=True):
    settings = {"encoding": "float32", "height": int(random.integers(1, 120)), "width": int(random.integers(1, 120))}
    settings["outputs"] = [str(one) for one in random.choice(OUTPUTS, size=random.integers(1, 4), replace=False)]
    if random.random() < 0.6:
        settings["probe"] = (
            to_dict(random.choice([*Probe.named.values()])) if random.random() < 0.5 else random_probe(random)
        )
    if random.random() < 0.3:
        settings["slice_thickness_mm"] = float(random.uniform(0.0, 4.0))
    if random.random() < 0.3:
        settings["tools"] = [[NEEDLE], [BOX], [NEEDLE, BOX]][random.integers(3)]
    if random.random() < 0.2:
        settings["ghost"] = float(random.uniform(0.1, 1.0))
    if random.random() < 0.3:
        settings["contact"] = str(random.choice(["air", "pressure"]))
    if has_speckle and random.random() < 0.2:
        settings["speckle"] = "natural"
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


def cloud(random, poses):
    """A scene of few large Gaussians that shine differently from each side."""

    def tensor(values):
        return torch.tensor(values, dtype=torch.float32)

    count = 3000
    splats = {
        "means": tensor(random.uniform(-2.0, 2.0, (count, 3)) * [1.5, 3.0, 1.5]),
        "scales": tensor(random.normal(-2.5, 0.4, (count, 3))),
        "quats": tensor(random.normal(size=(count, 4))),
        "transmittances": tensor(random.normal(4.0, 1.0, count)),
        "sh0": tensor(random.normal(1.0, 1.0, (count, 1, 1))),
        "shN": tensor(random.normal(0.0, 0.3, (count, 15, 1))),
    }
    probe = {"kind": "convex", "opening_angle_deg": 70.0, "near_mm": 30.0, "far_mm": 90.0}
    info = SceneInfo(centre_mm=(0.0, 19.0, 25.0), probe=from_dict(Probe, probe), image_height=90, image_width=70)
    return GaussianScene.from_splats(splats, info=info, training_poses=poses)


def dragged(scene):
    """The scene, as if its tissue had followed the probe along a path that a tracker told with errors."""
    tracked = scene.training_poses
    at_rest, errors = tracked.copy(), np.repeat(np.eye(4)[None], len(tracked), axis=0)
    at_rest[:, :3, 3] += np.sin(np.arange(len(tracked)) / 3.0)[:, None] * [0.8, 0.0, 0.5]
    info = replace(scene.info, tissue_shares=(0.6, 0.3, 1.0))
    given = {"labels": scene.labels, "pose_corrections": errors, "rest_poses": at_rest}
    return GaussianScene.from_splats(scene.splats, info=info, training_poses=tracked, **given)


def main(folder, count, seed):
    random = np.random.default_rng(seed)
    write_page(DEMO_FILE, folder)
    copy_demo_scene(folder / "demo.ugr")
    demo = GaussianScene.load(folder / "demo.ugr")
    scenes = {
        "scene.ugz": GaussianScene.load(folder / "scene.ugz"),
        CLOUD: cloud(random, demo.training_poses),
        "dragged.ugr": dragged(demo),
    }
    for name in (CLOUD, "dragged.ugr"):
        scenes[name].save(folder / name)
    requests = []
    with (folder / "expected.bin").open("wb") as expected:
        for number in range(count):
            name = str(random.choice([*scenes]))
            scene = scenes[name]
            pose = scene.training_poses[random.integers(len(scene.training_poses))].copy()
            pose[:3, :3] = pose[:3, :3] @ rotations_of(0.3 * random.normal() * random_directions(random, 1))[0]
            pose[:3, 3] += random.normal(scale=5.0, size=3)
            settings = random_settings(random, has_speckle=scene.info.speckle is not None)
            asked = from_dict(RenderSettings, settings)
            resolved = asked.resolved(scene.info, asked.encoding)
            shown = render_shown(scene, resolved, pose[None], backend="reference" if number < REFERENCE else "cpu")
            for output in resolved.outputs:
                expected.write(shown[output].numpy().astype("<f4").tobytes())
            display = resolved.display
            enlarged = max(1.0, FRAME_RANGE_DB / display.dynamic_range_db) * (1.0 + 2.0 * display.edge)
            requests.append({"scene": name, "pose": pose.ravel().tolist(), "settings": settings, "enlarged": enlarged})
    (folder / "requests.json").write_text(json.dumps(requests))


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]))
