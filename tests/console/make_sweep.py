"""What the tests of the console upload: writes sweep.zip, broken.zip, compared.ugr and refined.ugr into a folder.

sweep.zip is a small sweep over the demo scene (28 training and 5 held-out frames of 64x64), broken.zip the same with a
pose that is none, compared.ugr the demo scene as if it were trained from that sweep, refined.ugr the demo scene as if
it were trained with a beam, corrected poses and an uncertainty.
"""

import sys
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from ultragray import ElevationBeam, LinearProbe, render
from ultragray.datasets import Dataset, Sweep
from ultragray.datasets.released import write_released
from ultragray.datasets.source import load_dataset
from ultragray.phantom.demo import demo_poses, load_demo_scene
from ultragray.scene.confidence import DEPTHS, VARIANCE_TERMS, ConfidenceModel, DepthBands, Uncertainty

SIDE = 64
PROBE = LinearProbe(width_mm=60.0, near_mm=0.0, far_mm=60.0)
HELD_OUT_EVERY, BROKEN_FRAME = 7, 5
BEAM_MM = 3.27  # no step of a slider
SHIFT_MM = 0.01  # of each training pose more than of the one before
VARIANCES = {"floor": 1.0, "level": 0.1, "gap 1 mm": 0.6, "beyond": 0.4}


def main(folder):
    torch.set_num_threads(1)
    scene = load_demo_scene()
    refined(scene).save(folder / "refined.ugr")
    poses = demo_poses(33)
    rendered = render(scene, PROBE, poses, height=SIDE, width=SIDE, outputs=("bmode",)).bmode
    images = np.rint(255.0 * rendered.detach().numpy()).astype(np.uint8)
    held_out = np.arange(len(poses)) % HELD_OUT_EVERY == HELD_OUT_EVERY // 2
    train, val = (
        Sweep(images[chosen], poses[chosen], PROBE, np.flatnonzero(chosen), "sweep") for chosen in (~held_out, held_out)
    )
    files = folder / "files"
    write_released(Dataset("sweep", train, val), files)
    pack(files, folder / "sweep.zip")
    scene.info = replace(scene.info, dataset_name="sweep", dataset_sha256=load_dataset(files).sha256)
    scene.save(folder / "compared.ugr")
    broken = train.poses.copy()
    broken[BROKEN_FRAME, 0, 0] = np.nan
    np.save(files / "poses_train.npy", broken)
    pack(files, folder / "broken.zip")


def refined(scene):
    count = len(scene.training_poses)
    corrections = np.tile(np.eye(4), (count, 1, 1))
    corrections[:, 0, 3] = SHIFT_MM * np.arange(count)
    bands = DepthBands((0.3,) * DEPTHS, (0.04,) * DEPTHS)
    uncertainty = Uncertainty(tuple(VARIANCES.get(name, 0.0) for name in VARIANCE_TERMS), bands)
    confidence = ConfidenceModel((3.5, 1.2, 0.8, 0.1, 0.6), 0.06, (0.0,) * count, 20, 0.04, uncertainty=uncertainty)
    info = replace(scene.info, beam=ElevationBeam(BEAM_MM), confidence=confidence.to_dict())
    return replace(scene, info=info, pose_corrections=corrections)


def pack(files, path):
    with zipfile.ZipFile(path, "w") as archive:
        for file in files.iterdir():
            archive.write(file, file.name)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
