"""What an operator sees while real frames come late: the late frame, the scene, the preview of both: `make preview`.

Real frames come 20 to 1,000 ms late, each time 30% earlier or later at random, in the order in which they come. The
built-in phantom's are simulated (not by the renderer), with noise, under a robot that goes to and fro at some speed or
rests, and under a hand; the scene is the demo scene. Recorded ones are those of a second sweep that the scene was not
trained from, at 20 Hz, and of a hand between its training frames. Each is compared with the real frame of the present.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from measuring import Document, Lines, columns, measure_runs
from ultragray.datasets.source import SourceOptions, load_dataset
from ultragray.geometry.probe import FloatArray, Probe
from ultragray.learn.training import TrainingConfig, train
from ultragray.phantom import PHANTOM_PROBE, simulate
from ultragray.phantom.demo import load_demo_scene
from ultragray.rendering.frames import render
from ultragray.rendering.preview import Grey, Previewer
from ultragray.scene.gaussians import GaussianScene
from ultragray_studies.hand import MARGIN_S, Hand

DELAYS_MS = (20, 50, 100, 300, 1000)
JITTER = 0.3  # share of the delay
RATE_HZ, SECONDS = 20.0, 6.0
SIDE = 128  # pixels of a simulated frame
WAY_MM, TURN_S = 30.0, 0.5
NOISE = 0.01  # grey values, of a real frame
SETTLED_S = 1.0  # after the first real frame


@dataclass(frozen=True, eq=False)
class Moving:
    """Real frames [F, H, W] of a probe that moves, and the scene's at the same poses."""

    times_s: FloatArray  # [F]
    poses: FloatArray  # [F, 4, 4] mm
    probe: Probe
    real: Grey
    rendered: Grey


def phantom(poses: FloatArray) -> Moving:
    images = simulate(poses, probe=PHANTOM_PROBE, height=SIDE, width=SIDE).astype(np.float32) / 255.0
    noise = np.random.default_rng(0).normal(scale=NOISE, size=images.shape).astype(np.float32)
    real = np.clip(images + noise, 0.0, 1.0)
    return Moving(times(len(poses)), poses, PHANTOM_PROBE, real, frames_of(load_demo_scene(), poses, SIDE, SIDE))


def robot(mm_per_s: float, _: Path) -> Moving:
    """To and fro along the spine, with a pause at each end."""
    into_s = times(round(SECONDS * RATE_HZ)) % (2 * (WAY_MM / max(mm_per_s, 1e-9) + TURN_S))
    there_mm = np.clip(into_s * mm_per_s, 0.0, WAY_MM)
    back_mm = np.clip((into_s - WAY_MM / max(mm_per_s, 1e-9) - TURN_S) * mm_per_s, 0.0, WAY_MM)
    poses = np.tile(np.eye(4), (len(into_s), 1, 1))
    poses[:, 1, 3] = there_mm - back_mm - WAY_MM / 2
    return phantom(poses)


def hand(_: Path) -> Moving:
    count = round(SECONDS * RATE_HZ)
    swaying = Hand(np.random.default_rng(0), int((SECONDS + 2 * MARGIN_S) / 0.05), 0.0)
    return phantom(swaying.poses(times(count)))


def recorded(name: str, options: SourceOptions, data_folder: Path) -> Moving:
    """The held-out frames of a set, whose own the scene is trained from."""
    dataset = load_dataset(data_folder / name, options)
    scene = train(dataset, TrainingConfig.preset("fast", confidence=False))
    sweep = dataset.val
    real = sweep.images.astype(np.float32) / 255.0
    return Moving(times(len(real)), sweep.poses, sweep.probe, real, frames_of(scene, sweep.poses, *real.shape[1:]))


def times(count: int) -> FloatArray:  # [F] s
    return np.arange(count) / RATE_HZ


def frames_of(scene: GaussianScene, poses: FloatArray, height: int, width: int) -> Grey:  # [F, H, W]
    one_by_one = (render(scene, None, pose, height=height, width=width, outputs=("bmode",)) for pose in poses)
    return np.concatenate([frames["bmode"].detach().numpy() for frames in one_by_one])


def measure(take: Callable[[Path], Moving], data_folder: Path) -> Document:
    moving = take(data_folder)
    return {"frames": len(moving.real), "delays": {str(ms): seen(moving, ms / 1e3) for ms in DELAYS_MS}}


def seen(moving: Moving, delay_s: float) -> Document:
    """Mean PSNR of what is seen in place of the present real frame, and its error beside the one that was told."""
    random = np.random.default_rng(1)
    comes_s = moving.times_s + delay_s * random.uniform(1.0 - JITTER, 1.0 + JITTER, len(moving.times_s))
    preview, newest, expected = Previewer(moving.probe), -1, []
    errors: dict[str, list[float]] = {"late": [], "scene": [], "preview": []}  # mean squares, by frame
    for now, now_s in enumerate(moving.times_s):
        came = [k for k in range(newest + 1, now + 1) if comes_s[k] <= now_s]
        for k in came:
            preview.observe(moving.real[k], moving.rendered[k], moving.poses[k])
        newest = max([newest, *came])
        if newest < 0 or now_s < delay_s + SETTLED_S:
            continue
        preview_frame = preview.show(moving.rendered[now], moving.poses[now])
        pictures = {"late": moving.real[newest], "scene": moving.rendered[now], "preview": preview_frame.frame}
        for name, picture in pictures.items():
            errors[name].append(float(np.mean((picture - moving.real[now]) ** 2)))
        expected.append(preview_frame.expected_error or 0.0)
    if not expected:
        return {}
    return {
        **{f"{name}_db": float(-10.0 * np.log10(np.mean(one))) for name, one in errors.items()},
        "error": float(np.sqrt(np.mean(errors["preview"]))),
        "told": float(np.sqrt(np.mean(np.square(expected)))),
    }


def previewed_frames(runs: Document) -> Lines:
    """PSNR by path and delay."""
    text = "{late_db:.1f} → {preview_db:.1f} dB"
    rows = (
        {
            "path": name,
            "scene": f"{run['delays']['300']['scene_db']:.1f} dB",
            **{f"by {ms}": text.format_map(figures) if figures else "–" for ms, figures in run["delays"].items()},
        }
        for name, run in runs.items()
    )
    heads = {"Real frames": "{path}", **{f"{ms:,} ms late": f"{{by {ms}}}" for ms in DELAYS_MS}}
    return columns(rows, {**heads, "scene alone": "{scene}"})


RUNS = {
    **{f"phantom, robot, {mm_per_s:g} mm/s": partial(robot, mm_per_s) for mm_per_s in (20.0, 5.0, 1.0)},
    "phantom, robot at rest": partial(robot, 0.0),
    "phantom, hand": hand,
    "ultranerf_liver, the other side": partial(recorded, "ultranerf_liver", SourceOptions("0:90", "90:180")),
    "liver_convex, hand": partial(recorded, "liver_convex", SourceOptions()),
}

if __name__ == "__main__":
    measure_runs("preview", __doc__, {name: partial(measure, take) for name, take in RUNS.items()}, threads=1)
