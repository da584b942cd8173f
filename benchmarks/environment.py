"""Steps a second of the environment StandardPlane-v0 with a random policy, one and many at once.

    python benchmarks/environment.py

On the demo scene, and on every fourth of its Gaussians, which costs what a scene costs that is trained with so few.
Resets are included, an episode has 200 steps, contact is judged, and all cores are used. CPU time tells what a step
costs where other programs were running meanwhile; the load of the machine, this program's included, is told beside.
"""

from __future__ import annotations

import os
import time
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from measuring import write
from ultragray.phantom.demo import load_demo_scene
from ultragray.scene.gaussians import GaussianScene
from ultragray_studies.bench.report import measured
from ultragray_studies.gym import MOST_STEPS, UltragrayVectorEnv

SMALL = "every fourth Gaussian"
CASES = (  # scene, side of the frames, environments
    ("demo", 64, 64),
    ("demo", 128, 1),
    ("demo", 128, 64),
    ("demo", 256, 64),
    (SMALL, 64, 64),
    (SMALL, 128, 1),
    (SMALL, 128, 64),
)
STEPS, ROUNDS = 640, 3  # of a round, of all environments together

Row = dict[str, Any]


def main() -> None:
    torch.set_num_threads(os.cpu_count() or 1)
    scenes = {"demo": (demo := load_demo_scene()), SMALL: thinned(demo)}
    document: Row = {"measured": measured(torch.get_num_threads()), "steps": STEPS, "rounds": ROUNDS}
    rounds: dict[Any, list[tuple[float, float]]] = {case: [] for case in CASES}
    for case in CASES * ROUNDS:  # in turn, so that a busy minute of the machine is not one case's
        name, side, count = case
        rounds[case].append(took_s(scenes[name], side, count))
    document["rows"] = [
        {
            "scene": name,
            "gaussians": len(scenes[name].means),
            "side": side,
            "environments": count,
            "steps_per_s": float(np.median([STEPS / wall_s for wall_s, _ in rounds[name, side, count]])),
            "best_steps_per_s": max(STEPS / wall_s for wall_s, _ in rounds[name, side, count]),
            "cpu_ms": float(np.median([1000.0 * cpu_s / STEPS for _, cpu_s in rounds[name, side, count]])),
        }
        for name, side, count in CASES
    ]
    document["load"] = os.getloadavg()[2]
    write("environment", document)


def thinned(scene: GaussianScene) -> GaussianScene:
    """Every fourth Gaussian: it shows little, and costs what a scene costs that is trained with so few."""
    splats = {name: values[::4].contiguous() for name, values in scene.splats.items()}
    return replace(scene, **splats, labels=None if scene.labels is None else scene.labels[::4].contiguous())


def took_s(scene: GaussianScene, side: int, count: int) -> tuple[float, float]:
    """Wall time and CPU time of a round."""
    env = UltragrayVectorEnv(count, scene, height=side, width=side, max_episode_steps=MOST_STEPS)
    env.action_space.seed(0)
    env.reset(seed=0)
    actions = [env.action_space.sample() for _ in range(STEPS // count)]
    env.step(actions[0])
    began_s = time.perf_counter(), time.process_time()
    for action in actions:
        env.step(action)
    return time.perf_counter() - began_s[0], time.process_time() - began_s[1]


if __name__ == "__main__":
    main()
