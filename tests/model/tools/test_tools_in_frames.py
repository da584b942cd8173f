"""Tools in frames of tissue: consistent planes, the same on every backend, with gradients, contact and pressure."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from ultragray import ElevationBeam, LinearProbe, render
from ultragray.errors import UnknownOutput
from ultragray.rendering.backends import cpu
from ultragray.rendering.outputs import PLANES
from ultragray.rendering.settings import Contact
from ultragray.rendering.tools import Box, Cylinder, Needle, ToolFrame
from ultragray.scene.info import SceneInfo

from .conftest import LINEAR, PROBES

SIZE = {"height": 60, "width": 50}


def tools_of(probe):
    """One of each kind, across the image plane of a probe, in its frame."""

    def at(row, column):
        x, y, z = probe.points_mm(np.array(row), np.array(column)).tolist()
        return x, y, z

    x, _, z = at(0.5, 0.7)
    return (
        Needle(tip_mm=at(0.7, 0.6), hub_mm=at(0.1, 0.2), frame=ToolFrame.PROBE, label=1),
        Box(centre_mm=at(0.4, 0.45), size_mm=(6.0, 4.0, 2.0), frame=ToolFrame.PROBE, label=2),
        Cylinder(tip_mm=(x, -8.0, z), hub_mm=(x, 8.0, z), diameter_mm=5.0, frame=ToolFrame.PROBE, label=3),
    )


@pytest.fixture(scope="module")
def scene(random_scene):
    made = random_scene(400, extent_cm=(8.0, 2.0, 9.0), info={"probe": LINEAR})
    poses = np.tile(np.eye(4), (9, 1, 1))
    poses[:, 1, 3] = np.linspace(-8.0, 8.0, 9)
    return replace(made, training_poses=poses)


@pytest.mark.parametrize("ghost", [0.0, 0.5])
@pytest.mark.parametrize("probe", PROBES, ids=lambda probe: probe.kind)
def test_bmode_stays_echo_times_transmittance_and_amounts_stay_amounts(scene, random_poses, probe, ghost):
    poses = random_poses(2)
    more = {"tools": tools_of(probe), "beam": ElevationBeam(3.0), "ghost": ghost}
    frames = render(scene, probe, poses, **SIZE, outputs=(*PLANES, "labels", "attenuation"), **more)
    plain = render(scene, probe, poses, **SIZE, beam=ElevationBeam(3.0))
    torch.testing.assert_close(frames["bmode"], frames["echo"] * frames["transmittance"], atol=1e-5, rtol=0.0)
    for name in (*PLANES, "attenuation"):
        assert torch.isfinite(frames[name]).all()
        assert frames[name].min() >= 0.0
        assert frames[name].max() <= 1.0 + 1e-6
    assert set(frames["labels"].unique().tolist()) == {0, 1, 2, 3}
    assert (frames["bmode"] - plain["bmode"]).abs().max() > 0.2
    for name in PLANES:  # an output is the same, whatever else is asked for
        alone = render(scene, probe, poses, **SIZE, outputs=(name,), **more)
        torch.testing.assert_close(alone[name], frames[name], atol=1e-6, rtol=0.0)


def test_lines_that_meet_no_tool_keep_their_bytes(scene):
    needle = Needle(tip_mm=(0.0, 0.0, 30.0), hub_mm=(-10.0, 0.0, 10.0))
    plain = render(scene, LINEAR, np.eye(4), **SIZE)
    frames = render(scene, LINEAR, np.eye(4), **SIZE, tools=(needle,))
    beside = [column for column in range(50) if not -12.0 < (column + 0.5) * 0.8 - 20.0 < 2.0]
    for name in PLANES:
        assert torch.equal(frames[name][:, :, beside], plain[name][:, :, beside])
        assert not torch.equal(frames[name], plain[name])


@pytest.mark.parametrize("ghost", [0.0, 0.6])
def test_backends_agree(scene, random_poses, assert_agrees, ghost):
    poses, more = random_poses(3), {"tools": tools_of(LINEAR), "ghost": ghost}
    reference = render(scene.to(torch.float64), LINEAR, poses, **SIZE, **more, backend="reference")
    assert reference["bmode"].dtype == torch.float64
    for backend in ("reference", *(["cpu"] if cpu.supports(scene) else [])):
        fast = render(scene, LINEAR, poses, **SIZE, **more, backend=backend)
        assert_agrees(fast, {name: reference[name].numpy() for name in PLANES}, tolerance=5e-4)


@pytest.mark.slow
def test_the_cuda_backend_draws_the_same(random_scene, on_device, assert_agrees):
    pytest.importorskip("triton", reason="the package triton is not installed, which runs these kernels")
    small = random_scene(40, sigma_cm=(0.05, 0.3))
    asked = {"height": 24, "width": 20, "outputs": (*PLANES, "labels"), "tools": tools_of(LINEAR), "ghost": 0.5}
    expected = render(small, LINEAR, np.eye(4), **asked, backend="reference")
    found = render(on_device(small), LINEAR, np.eye(4), **asked, backend="cuda")
    assert_agrees(found, {name: expected[name].numpy() for name in PLANES}, tolerance=5e-4)
    assert torch.equal(found["labels"].cpu(), expected["labels"])


@pytest.mark.parametrize("backend", ["reference", "cpu"])
def test_gradients_reach_the_scene_and_the_pose(scene, backend):
    pose = torch.eye(4, dtype=torch.float64)[None].requires_grad_()
    leaf = replace(scene, sh0=scene.sh0.clone().requires_grad_())
    more = {"tools": tools_of(LINEAR), "ghost": 0.3, "backend": backend}
    frames = render(leaf, LINEAR, pose, **SIZE, outputs=("bmode", "echo"), **more)
    (frames["bmode"].sum() + frames["echo"].sum()).backward()
    for tensor in (pose, leaf.sh0):
        assert torch.isfinite(tensor.grad).all()
        assert float(tensor.grad.norm()) > 0
    plain = replace(scene, sh0=scene.sh0.clone().requires_grad_())
    render(plain, LINEAR, np.eye(4), **SIZE, outputs=("bmode",), backend=backend)["bmode"].sum().backward()
    assert plain.sh0.grad is not None
    assert leaf.sh0.grad is not None
    assert not torch.equal(plain.sh0.grad, leaf.sh0.grad)  # shadows take light from what lies in them


def test_labels_of_tools_lie_over_those_of_the_tissue(scene):
    needle = Needle(tip_mm=(5.0, 0.0, 30.0), hub_mm=(-10.0, 0.0, 10.0), label=9)
    asked = {**SIZE, "outputs": ("labels",)}
    with pytest.raises(UnknownOutput, match="labels"):
        render(scene, LINEAR, np.eye(4), **asked)
    alone = render(scene, LINEAR, np.eye(4), **asked, tools=(needle,))["labels"]
    assert set(alone.unique().tolist()) == {0, 9}
    labelled = replace(
        scene,
        labels=torch.full((len(scene.means),), 2, dtype=torch.uint8),
        info=replace(scene.info, label_names={2: "bone"}),
    )
    tissue = render(labelled, LINEAR, np.eye(4), **asked)["labels"]
    both = render(labelled, LINEAR, np.eye(4), **asked, tools=(needle,))["labels"]
    assert torch.equal(both == 9, alone == 9)
    assert torch.equal(both[both != 9], tissue[both != 9])
    assert isinstance(labelled.info, SceneInfo)


def test_a_tool_is_rigid_under_pressure(scene, empty_scene):
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[1, 2, 3], poses[2, 2, 3] = 5.0, 2.0  # pressed in: each pose is drawn alone
    empty = replace(empty_scene, training_poses=scene.training_poses, info=replace(empty_scene.info, probe=LINEAR))
    needle = Needle(tip_mm=(5.0, 0.0, 30.0), hub_mm=(-10.0, 0.0, 12.0))
    asked = {**SIZE, "outputs": ("labels", "transmittance"), "tools": (needle,)}
    expected = render(empty, None, poses, **asked)
    pressed = render(empty, None, poses, **asked, contact=Contact.PRESSURE)
    assert pressed.touch.pressed_mm.max() > 4.0
    for name in ("labels", "transmittance"):
        assert torch.equal(pressed[name], expected[name])


def test_lines_off_the_skin_show_no_tool(scene):
    lifted = np.eye(4)
    lifted[2, 3] = -5.0
    needle = Needle(tip_mm=(5.0, 0.0, 20.0), hub_mm=(-10.0, 0.0, 8.0), frame=ToolFrame.PROBE)
    frames = render(scene, None, lifted, **SIZE, tools=(needle,), contact=Contact.AIR, ghost=0.5)
    assert frames["bmode"].max() == 0.0
    assert frames["transmittance"].max() == 0.0


def test_frames_of_one_row_or_one_line_have_tools_too(scene):
    probe = LinearProbe(width_mm=30.0, near_mm=0.0, far_mm=40.0)
    for height, width in ((1, 1), (1, 40), (40, 1)):
        frames = render(scene, probe, np.eye(4), height=height, width=width, tools=tools_of(probe), ghost=0.5)
        assert torch.isfinite(frames["bmode"]).all()
        assert frames["transmittance"].min() < 0.9
    assert len(render(scene, probe, np.zeros((0, 4, 4)), **SIZE, tools=tools_of(probe), ghost=0.5)["bmode"]) == 0
