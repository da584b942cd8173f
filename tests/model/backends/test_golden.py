"""Our renderer against the released implementation's outputs in ../shared/golden."""

import numpy as np
import pytest
import torch

from ultragray.rendering.frames import render

FILES = ("g01", "g03", "g05", "g06", "g08")


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize(
    ("backend", "dtype", "tolerance"),
    [
        ("reference", torch.float32, 5e-4),
        ("reference", torch.float64, 5e-5),
        ("cpu", torch.float32, 5e-4),
        ("cuda", torch.float32, 5e-4),
        ("auto", torch.float32, 5e-4),
    ],
    ids=["reference-float32", "reference-float64", "cpu", "cuda", "auto"],
)
def test_all_outputs_match(golden, assert_agrees, on_device, name, backend, dtype, tolerance):
    file = golden(name)
    scene = on_device(file.scene(dtype)) if backend == "cuda" else file.scene(dtype)
    frames = render(scene, file.probe, file.poses, height=file.height, width=file.width, backend=backend)
    assert frames.bmode.dtype == dtype
    assert_agrees(frames, file.expected, tolerance=tolerance, stable=file.stable)


@pytest.mark.slow
def test_reference_gradient_is_the_true_gradient(golden):
    file = golden("g05")
    scene = file.scene(torch.float64)
    for tensor in scene.splats.values():
        tensor.requires_grad_()
    frames = render(
        scene,
        file.probe,
        file.poses,
        height=file.height,
        width=file.width,
        outputs=("bmode",),
        backend="reference",
    )
    assert frames.bmode is not None
    loss = (frames.bmode * torch.from_numpy(file.arrays["G"]).double()).sum()
    assert loss.item() == pytest.approx(float(file.arrays["loss"]), rel=1e-4)
    loss.backward()
    for name, tensor in scene.splats.items():
        want = file.arrays[f"true_grad_{name}"]
        error = np.linalg.norm(tensor.grad.numpy() - want) / np.linalg.norm(want)
        assert error < 1e-5, f"{name}: relative L2 error {error:.2g}"
