"""What the C++ kernel promises beyond right pictures: determinism, its cache, the interpreter lock, its limits."""

import os
import sys
import threading
import time
from dataclasses import replace

import numpy as np
import pytest
import torch

from ultragray import GaussianScene, LinearProbe, render
from ultragray.errors import BackendUnavailable
from ultragray.rendering.backends import cpu
from ultragray.rendering.confidence import supported_shares
from ultragray.rendering.display import Display
from ultragray.rendering.frames import render_shown
from ultragray.rendering.pixels import to_uint8
from ultragray.rendering.settings import Resolved
from ultragray.scene.confidence import SUPPORT_COVERAGE

PROBE = LinearProbe(width_mm=40.0, near_mm=0.0, far_mm=50.0)


@pytest.fixture
def threads():
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


def poses(count):  # [C, 4, 4] mm
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 1, 3] = np.linspace(-5.0, 5.0, count)
    poses[:, 2, 3] = -25.0
    return poses


@pytest.mark.usefixtures("threads")
@pytest.mark.parametrize("instruction_set", cpu.INSTRUCTION_SETS)
def test_the_number_of_threads_does_not_change_a_bit(random_scene, instruction_set):
    scene = random_scene(count=5000)
    frames = []
    for count in (1, 2, 5):
        torch.set_num_threads(count)
        inside = scene.poses_to_scene_cm(poses(20))
        frames.append(
            cpu.render_outputs(scene, PROBE, inside, 65, 193, ("bmode",), instruction_set=instruction_set)["bmode"]
        )
    assert frames[0].max() > 0.1
    assert torch.equal(frames[0], frames[1])
    assert torch.equal(frames[0], frames[2])


@pytest.mark.usefixtures("threads")
@pytest.mark.parametrize("instruction_set", cpu.INSTRUCTION_SETS)
def test_the_callers_thread_keeps_its_smallest_numbers(random_scene, instruction_set):
    torch.set_num_threads(1)  # the caller draws
    scene = random_scene(count=100)
    cpu.render_outputs(
        scene, PROBE, scene.poses_to_scene_cm(poses(1)), 9, 9, ("bmode",), instruction_set=instruction_set
    )
    assert np.float32(1e-30) * np.float32(1e-10) > 0.0


@pytest.mark.usefixtures("threads")
@pytest.mark.parametrize("instruction_set", cpu.INSTRUCTION_SETS)
@pytest.mark.parametrize("size", [(65, 193), (3, 5)])
def test_bytes_of_one_pass_are_those_of_the_planes(random_scene, instruction_set, size):
    scene = random_scene(count=5000)
    inside = scene.poses_to_scene_cm(poses(11))
    planes = cpu.render_outputs(scene, PROBE, inside, *size, ("bmode", "coverage"), instruction_set=instruction_set)
    for count in (1, 3):
        torch.set_num_threads(count)
        grey, shares = cpu.render_grey(scene, PROBE, inside, *size, SUPPORT_COVERAGE, instruction_set=instruction_set)
        assert np.array_equal(grey.numpy(), to_uint8(planes["bmode"].numpy()))
        assert np.array_equal(shares, supported_shares(planes["coverage"]).numpy())
    assert 0.0 < shares.min() < 1.0


def test_frames_that_nothing_is_put_into_come_in_bytes_at_once(random_scene):
    scene, at = random_scene(count=500), poses(2)
    plain = Resolved(PROBE, 16, 20)
    for settings in (plain, replace(plain, display=Display(gain_db=6.0)), replace(plain, ghost=0.3)):
        grey = render_shown(scene, settings, at, in_bytes=True)["bmode"]
        assert np.array_equal(to_uint8(grey.numpy()), to_uint8(render_shown(scene, settings, at)["bmode"].numpy()))
        assert (grey.dtype == torch.uint8) == (settings is plain)


@pytest.mark.long
@pytest.mark.usefixtures("threads")
def test_helpers_leave_the_caller_the_processors_it_may_run_on(random_scene):
    scene, before = random_scene(count=50), os.sched_getaffinity(0)
    torch.set_num_threads(4)
    for _ in range(5000):  # so short that many a helper ends before its caller goes on
        render(scene, PROBE, poses(1), height=2, width=512, backend="cpu")
    assert os.sched_getaffinity(0) == before


@pytest.mark.usefixtures("threads")
def test_a_caller_bound_to_one_processor_renders_the_same(random_scene):
    scene, before = random_scene(count=500), os.sched_getaffinity(0)
    torch.set_num_threads(2)
    free = render(scene, PROBE, poses(1), height=64, width=128, backend="cpu")
    os.sched_setaffinity(0, {min(before)})
    try:
        bound = render(scene, PROBE, poses(1), height=64, width=128, backend="cpu")
    finally:
        os.sched_setaffinity(0, before)
    assert bound.bmode is not None
    assert torch.equal(free.bmode, bound.bmode)


def test_other_python_threads_run_while_it_renders(random_scene):
    scene = random_scene(count=20_000)
    render(scene, PROBE, poses(1), height=8, width=8)  # prepares the scene
    done, most = threading.Event(), 0
    beats = []

    def beat():
        while not done.is_set():
            beats.append(time.perf_counter())
            time.sleep(0.001)

    interval = sys.getswitchinterval()
    beating = threading.Thread(target=beat)
    beating.start()
    for _ in range(20):  # others may keep the thread from its turns
        started = time.perf_counter()
        render(scene, PROBE, np.repeat(poses(1), 24, axis=0), height=512, width=256, outputs=("bmode",))
        most = max(most, sum(started + interval < one for one in beats))
        if most >= 3:
            break
    done.set()
    beating.join()
    assert most >= 3


def test_what_it_cannot_render_is_refused(random_scene):
    scene = random_scene(count=10)
    with pytest.raises(BackendUnavailable, match="float64"):
        render(scene.to(torch.float64), PROBE, poses(1), height=8, width=8, backend="cpu")
    with pytest.raises(BackendUnavailable, match="instruction_set must be auto or one of"):
        cpu.render_outputs(scene, PROBE, poses(1), 8, 8, ("bmode",), instruction_set="sse9")


def test_a_scene_that_shares_tensors_has_its_own_preparation(random_scene):
    scene = random_scene(count=50)
    render(scene, PROBE, poses(1), height=16, width=16)
    sigmoid = replace(scene, info=replace(scene.info, intensity="sigmoid"))
    echo = render(sigmoid, PROBE, poses(1), height=16, width=16, outputs=("echo",)).echo
    exact = render(sigmoid.to(torch.float64), PROBE, poses(1), height=16, width=16, outputs=("echo",)).echo
    assert exact is not None
    assert (echo - exact).abs().max() < 5e-4


def test_a_replaced_tensor_is_noticed(random_scene):
    scene = random_scene(count=50)
    for _ in range(6):  # the allocator may hand out an address again
        scene.means = scene.means + 0.05
        fresh = GaussianScene.from_splats(scene.splats)
        size = {"height": 16, "width": 16, "outputs": ("bmode",)}
        assert torch.equal(render(scene, PROBE, poses(1), **size).bmode, render(fresh, PROBE, poses(1), **size).bmode)


def test_torch_defaults_and_inference_mode_do_not_matter(random_scene):
    before = render(random_scene(count=50), PROBE, poses(1), height=16, width=16).bmode
    torch.set_default_dtype(torch.float64)
    try:
        assert torch.equal(render(random_scene(count=50), PROBE, poses(1), height=16, width=16).bmode, before)
    finally:
        torch.set_default_dtype(torch.float32)
    with torch.inference_mode():
        assert torch.equal(render(random_scene(count=50), PROBE, poses(1), height=16, width=16).bmode, before)
