"""Milliseconds of frames along the demo scene's sweep by the kernels of 128 bits on one thread, as JSON.

`measure_native.py SIDE FRAMES`.
"""

import json
import sys
import time

import torch

from ultragray import GaussianScene
from ultragray.phantom.demo import DEMO_FILE
from ultragray.rendering.backends import cpu
from ultragray.rendering.backends.inputs import scene_poses


def main(side, frames):
    torch.set_num_threads(1)
    scene = GaussianScene.load(DEMO_FILE)
    poses = scene_poses(scene, scene.training_poses)
    found = []
    for number in range(-5, frames):
        pose = poses[(number + 5) % len(poses)][None]
        before = time.perf_counter()
        cpu.render_grey(scene, scene.info.probe, pose, side, side, 0.3, instruction_set="baseline")
        if number >= 0:
            found.append(1e3 * (time.perf_counter() - before))
    json.dump(found, sys.stdout)


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]))
