"""Makes the demo scene and its pictures: `make demo-scene`.

Simulates the phantom, trains with the preset `fast`, measures on the held-out sweep, gives each Gaussian the label of
the tissue that it lies in, and puts `spine.ugr` in its place in the package and the README's pictures into docs/images.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from bone_shadow import BoneShadow
from ultragray.files import write_whole
from ultragray.geometry.probe import FloatArray, Probe, RadialProbe, SteeredProbe
from ultragray.learn.evaluation.scoring import render_sweep
from ultragray.learn.sweep import Dataset
from ultragray.learn.training import Progress, TrainingConfig, train
from ultragray.phantom import load_phantom, tissue_at
from ultragray.phantom.demo import DEMO_FILE, LABEL_NAMES, labels_of
from ultragray.rendering.display import true_to_scale
from ultragray.rendering.frames import render, show
from ultragray.rendering.pixels import png_file
from ultragray.scene.gaussians import GaussianScene

DATASET_NAME = "demo lumbar spine (in silico)"
MAX_GAUSSIANS = 50_000  # 3 MB, small enough to come with the code
PICTURES_FOLDER = Path(__file__).parents[1] / "docs" / "images"
PICTURE_SIDE = 512
PARAMEDIAN_MM = 12.0  # from the midline, across the laminae
CATHETER_MM = (12.0, 0.0, 22.0)  # within the muscle, beside the vessel
SECONDS_PER_LINE = 10.0

log = logging.getLogger("demo")


def main() -> None:
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
    log.info("simulating the phantom")
    scene = labelled(make_scene(load_phantom(), TrainingConfig.preset("fast", max_gaussians=MAX_GAUSSIANS)))
    scene.save(DEMO_FILE)
    write_pictures(scene, PICTURES_FOLDER)
    figures = ", ".join(f"{name} {value:.4g}" for name, value in scene.info.metrics.items())
    log.info("wrote %s: %d Gaussians, %d bytes, %s", DEMO_FILE, scene.gaussian_count, DEMO_FILE.stat().st_size, figures)


def make_scene(dataset: Dataset, config: TrainingConfig) -> GaussianScene:
    """The demo scene, trained from the phantom's dataset and measured on its held-out sweep, shadows included."""
    scene = train(dataset, config, report=_progress_logger())
    shadow = BoneShadow.of(dataset.val)
    metrics = {
        **scene.info.metrics,
        "shadow_mae": shadow.mean_absolute_error(render_sweep(scene, dataset.val)),
        "shadow_transmittance": shadow.mean(render_sweep(scene, dataset.val, output="transmittance")),
    }
    return replace(scene, info=replace(scene.info, dataset_name=DATASET_NAME, metrics=metrics))


def labelled(scene: GaussianScene) -> GaussianScene:
    """The scene with the label of the phantom's tissue at each mean; other tissues than those of LABELS have none."""
    means_mm = np.asarray(scene.info.centre_mm) + 10.0 * scene.means.detach().cpu().double().numpy()
    labels = torch.from_numpy(labels_of(tissue_at(means_mm))).to(scene.means.device)
    return replace(scene, info=replace(scene.info, label_names=LABEL_NAMES), labels=labels)


def _progress_logger() -> Callable[[Progress], None]:
    logged_at = time.monotonic()

    def log_progress(progress: Progress) -> None:
        nonlocal logged_at
        if time.monotonic() - logged_at >= SECONDS_PER_LINE:
            logged_at = time.monotonic()
            log.info(
                "step %d of %d, loss %.4f, %.0f s left",
                progress.step,
                progress.steps,
                progress.loss,
                progress.seconds_left,
            )

    return log_progress


def picture_views() -> dict[str, tuple[Probe | None, FloatArray]]:  # poses [4, 4] mm
    """The README's views, by name, with a probe other than the scene's where one is meant.

    Transverse over the middle vertebra, also steered and from a catheter within the muscle; paramedian sagittal across
    the laminae.
    """
    sagittal, inside = np.eye(4), np.eye(4)
    sagittal[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]  # columns of the image run caudal
    sagittal[0, 3] = PARAMEDIAN_MM
    inside[:3, 3] = CATHETER_MM
    return {
        "transverse": (None, np.eye(4)),
        "sagittal": (None, sagittal),
        "steered": (SteeredProbe(width_mm=38.0, steering_deg=15.0, near_mm=0.0, far_mm=45.0), np.eye(4)),
        "radial": (RadialProbe(near_mm=1.5, far_mm=20.0), inside),
    }


def write_pictures(scene: GaussianScene, folder: Path) -> None:
    """Writes `demo_<view>.png` of each of `picture_views` into an existing folder, true to scale."""
    for view, (own_probe, pose) in picture_views().items():
        probe = scene.info.probe_or(own_probe)
        frames = render(scene, probe, pose, height=PICTURE_SIDE, width=PICTURE_SIDE, outputs=("bmode",))
        picture = show(frames, probe, true_to_scale(probe, PICTURE_SIDE, PICTURE_SIDE))["bmode"]
        write_whole(folder / f"demo_{view}.png", png_file(picture[0].numpy()))


if __name__ == "__main__":
    main()
