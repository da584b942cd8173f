"""Our renderer against the released implementation's outputs in ../shared/golden."""

import pytest
import torch

from ultragray.rendering.frames import render

FILES = ("g01", "g03", "g05", "g06", "g08")


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize(
    ("backend", "dtype", "tolerance"),
    [("reference", torch.float64, 5e-5), ("cpu", torch.float32, 5e-4), ("cuda", torch.float32, 5e-4)],
    ids=["reference", "cpu", "cuda"],
)
def test_all_outputs_match(golden, assert_agrees, on_device, name, backend, dtype, tolerance):
    file = golden(name)
    scene = on_device(file.scene(dtype)) if backend == "cuda" else file.scene(dtype)
    frames = render(scene, file.probe, file.poses, height=file.height, width=file.width, backend=backend)
    assert frames.bmode.dtype == dtype
    assert_agrees(frames, file.expected, tolerance=tolerance, stable=file.stable)
