"""Steps a second of the environment StandardPlane-v0 with a random policy, on the demo scene.

    python benchmarks/environment.py

1,000 steps of each case, resets included, after some that are not counted.
"""

from __future__ import annotations

import argparse
import json
import time
from typing import Any

import gymnasium
import numpy as np
import torch

from registry import FIGURES
from ultragray.demo import DEMO_FILE
from ultragray.files.atomic import write_whole
from ultragray.gym import STANDARD_PLANE
from ultragray.scene import GaussianScene
from ultragray_service.bench.measured import measured

OUTPUT = FIGURES["environment"].staged
SIDES = (64, 128, 256)
CONTACTS = (None, "air", "pressure")
THREADS = (1, 2)
STEPS, UNCOUNTED = 1000, 50

Row = dict[str, Any]


def main() -> None:
    argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0]).parse_args()
    scene = GaussianScene.load(DEMO_FILE)
    document = {
        "measured": measured(max(THREADS)),
        "gaussians": scene.gaussian_count,
        "steps": STEPS,
        "rows": [
            of_random_policy(scene, side, contact, threads)
            for side in SIDES
            for contact in CONTACTS
            for threads in THREADS
        ],
    }
    OUTPUT.parent.mkdir(parents=True, exist_ok=True)
    write_whole(OUTPUT, json.dumps(document, indent=1, allow_nan=False) + "\n")


def of_random_policy(scene: GaussianScene, side: int, contact: str | None, threads: int) -> Row:
    """Steps a second, and the time of one step."""
    torch.set_num_threads(threads)
    env = gymnasium.make(STANDARD_PLANE, scene=scene, height=side, width=side, contact=contact)
    env.action_space.seed(0)
    env.reset(seed=0)
    took_ms: list[float] = []
    for number in range(UNCOUNTED + STEPS):
        if number == UNCOUNTED:
            began = time.perf_counter()
        before = time.perf_counter()
        *_, reached, over, _ = env.step(env.action_space.sample())
        took_ms.append(1000.0 * (time.perf_counter() - before))
        if reached or over:
            env.reset()
    seconds = time.perf_counter() - began
    p50_ms, p99_ms = np.percentile(took_ms[UNCOUNTED:], (50, 99)).tolist()
    return {
        "side": side,
        "contact": contact,
        "threads": threads,
        "steps_per_s": STEPS / seconds,
        "p50_ms": p50_ms,
        "p99_ms": p99_ms,
    }


if __name__ == "__main__":
    main()
