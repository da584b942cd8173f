"""What edits of scenes do to frames: `make editing`.

Insertions: random lesions in the demo scene, each in a frame through its middle, beside the frame before. A seam is a
mean change of the echo, over all that is as far from the surface, by more than SEAM: outside against the frame before,
inside against the body's own echo. The detector is held against bodies around which a gap was left.

Merging: the demo scene, cut in two and put together; and scenes of two overlapping halves of a sweep, beside one of all
of it, on held-out frames. A scene that lies in build/bench/editing is taken as it is. Thinning: frames at the training
poses of the demo scene, against those of all Gaussians.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import torch

from measuring import STAGE, Document, Lines, columns, measure_runs
from ultragray import GaussianScene, render
from ultragray.datasets.source import load_dataset
from ultragray.learn.editing.editor import edit_scene
from ultragray.learn.editing.insertion import draw_lesions, insert
from ultragray.learn.editing.parts import means_mm, part
from ultragray.learn.sweep import Dataset, Sweep
from ultragray.learn.training import TrainingConfig, train
from ultragray.phantom.demo import load_demo_scene
from ultragray.scene.confidence import supported
from ultragray.scene.edits import CutEdit, InsertEdit, LesionsEdit, MergeEdit, ThinEdit
from ultragray.scene.shapes import BoxShape

INSERTIONS, BATCH, CONTROLS = 500, 50, 2  # of a batch: bodies with and without a gap
AROUND_MM = 12.0  # a body: the part of the scene that a frame of it needs
SIDE = 192  # of frames
SEAM = 0.06  # of the grey range: 3.6 dB of 60
BIN_MM, INNER_MM, OUTER_MM = 0.25, 1.5, 3.0  # of the distance to the surface
LEAST_PIXELS = 30  # in a bin
EDGE_MM = 0.25  # as near lies the edge of the body itself
GAP_MM = 1.5  # of the controls
SET, STEPS, MAX_GAUSSIANS = "ultranerf_liver", 250, 12_000
HALVES = {"both": (0.0, 1.0), "first": (0.0, 0.6), "second": (0.4, 1.0)}
SHARES = (0.75, 0.5, 0.25)
THREADS = 1
Change = Callable[[GaussianScene, InsertEdit], GaussianScene]


def insertions(first: int, _: Path) -> Document:
    scene = load_demo_scene()
    results = [changes(scene, seed, insert) for seed in range(first, first + BATCH)]
    controls = [changes(scene, seed, with_gap)[0] for seed in range(first, first + CONTROLS)]
    return {
        "changes": [round(one[0], 4) for one in results],
        "label_errors_pixels": [round(one[1], 3) for one in results],
        "controls": [round(one, 4) for one in controls],
    }


def changes(scene: GaussianScene, seed: int, put_in: Change) -> tuple[float, float]:
    """The largest mean change of the echo beside the surface of a body, and how far its label errs, in pixels."""
    (edit,) = draw_lesions(scene, LesionsEdit(count=1, seed=seed))
    probe, low, high = scene.info.probe_or(None), *edit.shape.bounds_mm()
    near = np.abs(means_mm(scene)[:, 1] - 0.5 * (low + high)[1]) < 0.5 * (high - low)[1] + AROUND_MM
    scene = part(scene, near)
    pose = np.eye(4)
    pose[1, 3] = 0.5 * (low + high)[1]
    origins, directions = probe.scan_lines(SIDE)
    points = origins + probe.depths_mm(SIDE)[:, None, None] * directions + pose[:3, 3]
    away = edit.shape.distance_mm(points.reshape(-1, 3)).reshape(SIDE, SIDE)
    edited = put_in(scene, edit)
    before, after = (
        render(one, probe, pose, height=SIDE, width=SIDE, outputs=names)
        for one, names in ((scene, ("echo",)), (edited, ("echo", "labels", "coverage")))
    )
    here, there = after["echo"][0].numpy(), before["echo"][0].numpy()
    (label,) = edited.info.made_labels
    is_wrong = ((after["labels"][0].numpy() == label) != (away < 0.0)) & supported(after["coverage"][0].numpy())
    pixel_mm = np.hypot(probe.scan_line_length_mm, np.linalg.norm(origins[-1] - origins[0])) / SIDE
    error = float(np.abs(away[is_wrong]).max() / pixel_mm) if is_wrong.any() else 0.0
    own = float(here[away < min(-EDGE_MM, 0.5 * float(away.min()))].mean())
    apart = np.where(away < 0.0, here - own, here - there)
    worst = 0.0
    for first in np.arange(-INNER_MM, OUTER_MM, BIN_MM):
        inside = (away >= first) & (away < first + BIN_MM)
        if -EDGE_MM <= first < EDGE_MM or inside.sum() < LEAST_PIXELS:
            continue
        worst = max(worst, abs(float(apart[inside].mean())))
    return worst, error


def with_gap(scene: GaussianScene, edit: InsertEdit) -> GaussianScene:
    edited = insert(scene, edit)
    (label,) = edited.info.made_labels
    far = edit.shape.distance_mm(means_mm(edited)) > GAP_MM
    assert edited.labels is not None
    return part(edited, far | (edited.labels.numpy() == label))


def merging(data_folder: Path) -> Document:
    demo, poses = load_demo_scene(), load_demo_scene().training_poses[::20]
    box = BoxShape(min_mm=(-100.0, -100.0, -10.0), max_mm=(2.0, 100.0, 100.0))
    left, right = (edit_scene(demo, [CutEdit(shape=box, keep=side)]) for side in ("inside", "outside"))
    again = edit_scene(left, [MergeEdit(scene="right", match_gain=False)], others={"right": right})
    dataset = load_dataset(data_folder / SET)
    scenes = {name: trained(dataset, name) for name in HALVES}
    others = {"second": scenes["second"]}
    for name, steps in (("joined", 0), ("merged", 300)):
        scenes[name] = edit_scene(scenes["first"], [MergeEdit(scene="second", fit_steps=steps)], others=others)
    val = halved(dataset.val)
    return {
        "cut_and_merged_largest_change": float((drawn(again, poses) - drawn(demo, poses)).abs().max()),
        "psnr_db": {name: against(one, val) for name, one in scenes.items()},
        "gaussians": {name: one.gaussian_count for name, one in scenes.items()},
    }


def trained(dataset: Dataset, name: str) -> GaussianScene:
    path = STAGE / "editing" / f"{name}.ugr"
    if path.exists():
        return GaussianScene.load(path)
    first, last = (round(share * len(dataset.train)) for share in HALVES[name])
    train_part = halved(dataset.train.select(np.arange(first, last)))
    config = TrainingConfig.preset("fast", steps=STEPS, max_gaussians=MAX_GAUSSIANS, confidence=False, seed=1)
    scene = train(replace(dataset, train=train_part, val=halved(dataset.val)), config)
    path.parent.mkdir(parents=True, exist_ok=True)
    scene.save(path)
    return scene


def halved(sweep: Sweep) -> Sweep:
    return replace(sweep, images=np.ascontiguousarray(sweep.images[:, ::2, ::2]))


def drawn(scene: GaussianScene, poses: np.ndarray) -> torch.Tensor:  # [C, 4, 4] -> [C, H, W]
    with torch.no_grad():
        return render(scene, None, poses, height=SIDE, width=SIDE, outputs=("bmode",))["bmode"]


def against(scene: GaussianScene, sweep: Sweep) -> float:
    size = {"height": sweep.height, "width": sweep.width, "outputs": ("bmode",)}
    bmode = render(scene, sweep.probe, sweep.poses, **size)["bmode"].numpy()
    squares = np.square(bmode - sweep.images / 255.0).mean(axis=(1, 2))
    return float(np.mean(-10.0 * np.log10(squares)))


def thinning(_: Path) -> Document:
    demo = load_demo_scene()
    poses = demo.training_poses[::10]
    whole = drawn(demo, poses)
    mixed = np.random.default_rng(0).permutation(demo.gaussian_count)
    scores: Document = {}
    for share in SHARES:
        count = round(share * demo.gaussian_count)
        thinned = edit_scene(demo, [ThinEdit(gaussian_count=count)])
        at_random = part(demo, np.sort(mixed[:count]))
        scores[f"{share:g}"] = {
            name: psnr(drawn(one, poses), whole) for name, one in (("chosen", thinned), ("random", at_random))
        }
    return scores


def psnr(frames: torch.Tensor, truth: torch.Tensor) -> float:  # [C, H, W] both
    return float((-10.0 * (frames - truth).square().mean(dim=(1, 2)).log10()).mean())


def lines(measured: Document) -> Lines:
    """The table of the documents."""
    merged, thinned = measured["merging"], measured["thinning"]
    batches = [one for name, one in measured.items() if name.startswith("insertions")]
    apart, edges, controls = (
        np.concatenate([batch[name] for batch in batches]) for name in ("changes", "label_errors_pixels", "controls")
    )
    db = merged["psnr_db"]
    rows = [
        ("Random insertions; in which the detector finds a seam", f"{len(apart)}; {int((apart > SEAM).sum())}"),
        ("Largest mean change beside a body, of the grey range", f"{apart.max():.3f}"),
        ("Bodies with a gap around them; found", f"{len(controls)}; {int((controls > SEAM).sum())}"),
        ("Largest error of a label's edge, pixels", f"{edges.max():.2f}"),
        ("Largest change of a pixel, cut in two and merged", f"{merged['cut_and_merged_largest_change']:.1g}"),
        ("Held-out PSNR of two halves of a sweep, dB", f"{db['first']:.2f}; {db['second']:.2f}"),
        ("of both merged; joined without a fit, dB", f"{db['merged']:.2f}; {db['joined']:.2f}"),
        ("of one scene trained on both, dB", f"{db['both']:.2f}"),
    ]
    for share in map(str, SHARES):
        one = thinned[share]
        what = f"PSNR with {float(share):.0%} of the Gaussians; of as many at random, dB"
        rows.append((what, f"{one['chosen']:.1f}; {one['random']:.1f}"))
    return columns([{"what": what, "found": value} for what, value in rows], {"Measured": "{what}", "": "{found}"})


RUNS = {
    "merging": merging,
    "thinning": thinning,
    **{f"insertions {first}": partial(insertions, first) for first in range(0, INSERTIONS, BATCH)},
}

if __name__ == "__main__":
    measure_runs("editing", __doc__, RUNS, threads=THREADS)
