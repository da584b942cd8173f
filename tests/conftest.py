"""Fixtures shared by all tests: golden files, random scenes, and the rule by which two renders agree."""

import asyncio
import gc
import inspect
import json
import math
import os
import time
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import hypothesis
import hypothesis.configuration
import numpy as np
import pytest
import torch

from ultragray import ConvexProbe, GaussianScene, LinearProbe, Probe, SceneInfo
from ultragray.exchange.released_config import stretch_released_far
from ultragray.geometry.probe import FloatArray
from ultragray.rendering.backends import cuda
from ultragray.rendering.outputs import PLANES
from ultragray.scene.gaussians import PARAMETERS
from ultragray_studies.bench.report import measured

from .object_storage import new_bucket, object_proxy, object_server
from .postgres import new_database, postgres
from .surroundings import ROOT, forget_the_users_environment, home_of_the_tests, working_folder
from .waiting import SkippingLoop

__all__ = [
    "home_of_the_tests",
    "new_bucket",
    "new_database",
    "object_proxy",
    "object_server",
    "postgres",
    "working_folder",
]

gc.disable()  # until the tests have been collected: modules and tests are no garbage, and looking at them takes seconds

if not torch.cuda.is_available():
    os.environ.setdefault("TRITON_INTERPRET", "1")  # before any kernel is imported: they run on the CPU then

forget_the_users_environment()
hypothesis.configuration.set_hypothesis_home_dir(ROOT / ".hypothesis")  # else it is in the working folder of a test
hypothesis.settings.register_profile("untimed", deadline=None)  # others may keep the machine busy
hypothesis.settings.load_profile("untimed")
torch.set_num_threads(1)  # also for fixtures of more than one test

os.environ["PYTEST_RUN"] = str(os.getpid())  # in the environment of every process that these tests start

BEGAN = time.monotonic()
SHARED = ROOT.parent / "shared"
HUNG_S = 600.0  # a test that waits for longer fails
LARGEST_FLIP = 5e-3  # a threshold that flips moves a pixel by about 1/255


def shared_folder(name):
    folder = SHARED / name
    if not folder.is_dir():
        pytest.skip(f"../shared/{name} is not there: it holds the released implementation's files")
    return folder


@pytest.fixture(autouse=True)
def one_torch_thread():
    """Small tensors gain nothing from more, and threads of several processes that spin cost seconds."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture
def clock(monkeypatch):
    """An event loop whose time is everybody's, and goes on without anybody waiting."""
    loop = SkippingLoop()
    for name in ("time", "monotonic"):
        monkeypatch.setattr(time, name, loop.time)
    yield loop
    loop.close()


@pytest.hookimpl(tryfirst=True)
def pytest_pyfunc_call(pyfuncitem):
    """A test that is a coroutine function runs to its end on a loop of its own, or on its `clock`."""
    if not inspect.iscoroutinefunction(pyfuncitem.obj):
        return None
    arguments = {name: pyfuncitem.funcargs[name] for name in pyfuncitem._fixtureinfo.argnames}
    test = pyfuncitem.obj(**arguments)
    if "clock" in arguments:
        arguments["clock"].run_until_complete(test)
    else:
        asyncio.run(asyncio.wait_for(test, HUNG_S))
    return True


@pytest.fixture
def golden_folder():
    return shared_folder("golden")


@pytest.fixture
def data_folder():
    return shared_folder("data")


@dataclass(frozen=True)
class Golden:
    """One golden file as ours: the depth stretch is applied, poses are in mm."""

    arrays: Mapping[str, np.ndarray]
    probe: Probe
    poses: FloatArray  # [C, 4, 4] mm
    height: int
    width: int
    expected: Mapping[str, np.ndarray]  # by output, [C, H, W] float64
    stable: np.ndarray  # [C, H, W] bool

    def scene(self, dtype):
        return GaussianScene.from_splats({name: torch.from_numpy(self.arrays[name]).to(dtype) for name in PARAMETERS})


@pytest.fixture
def golden(golden_folder):
    def load(name):
        with np.load(golden_folder / f"{name}.npz") as file:
            arrays = dict(file)
        height, width = int(arrays["height"]), int(arrays["width"])
        near_cm = float(arrays["near_plane"])
        far_cm = stretch_released_far(near_cm, float(arrays["far_plane"]), height)
        if "opening_width" in arrays:
            probe = LinearProbe(float(arrays["opening_width"]) * 10, near_cm * 10, far_cm * 10)
        else:
            probe = ConvexProbe(
                opening_angle_deg=float(arrays["opening_angle"]), near_mm=near_cm * 10, far_mm=far_cm * 10
            )
        poses = arrays["camtoworlds"].astype(np.float64)
        poses[:, :3, 3] *= 10.0
        weight_sum = arrays["echo_alpha"].astype(np.float64)
        expected = {
            "bmode": arrays["ultrasound"],
            "echo": arrays["echo"],
            "transmittance": arrays["transmittance"],
            "coverage": -np.expm1(-weight_sum),
        }
        return Golden(arrays, probe, poses, height, width, expected, ~arrays["unstable"])

    return load


@pytest.fixture(scope="session")
def random_scene():
    def make(
        count=200,
        *,
        seed=0,
        extent_cm=(3.0, 1.0, 4.0),
        centre_cm=(0.0, 0.0, 2.0),
        sigma_cm=(0.03, 0.2),  # each axis is drawn log-uniformly between these
        sh_degree=1,
        intensity="released",
        transmittance_logit=(0.0, 4.0),
        dtype=torch.float32,
        info=None,
    ):
        rng = np.random.default_rng(seed)
        low, high = np.log(sigma_cm)
        splats = {
            "means": (rng.random((count, 3)) - 0.5) * extent_cm + centre_cm,
            "scales": rng.uniform(low, high, (count, 3)),
            "quats": rng.normal(size=(count, 4)),
            "transmittances": rng.uniform(*transmittance_logit, count),
            "sh0": rng.uniform(-1.5, 0.5, (count, 1, 1)),
            "shN": rng.normal(size=(count, (sh_degree + 1) ** 2 - 1, 1)) * 0.2,
        }
        tensors = {name: torch.from_numpy(v.astype(np.float32)).to(dtype) for name, v in splats.items()}
        return GaussianScene.from_splats(tensors, info=SceneInfo(intensity=intensity, **(info or {})))

    return make


@pytest.fixture(scope="session")
def random_poses():
    def make(count, *, seed=0, tilt_deg=20.0, shift_mm=3.0):
        """[count, 4, 4]: rotations by up to `tilt_deg` about random axes, shifts by up to `shift_mm`."""
        rng = np.random.default_rng(seed)
        poses = np.tile(np.eye(4), (count, 1, 1))
        for pose in poses:
            axis = rng.normal(size=3)
            x, y, z = axis / np.linalg.norm(axis)
            cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
            angle = math.radians(rng.uniform(-tilt_deg, tilt_deg))
            pose[:3, :3] = np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross
            pose[:3, 3] = rng.uniform(-shift_mm, shift_mm, 3)
        return poses

    return make


# Folders all of whose tests are `long`, or want an image: importing them takes each test process seconds.
_LONG_FOLDERS = {
    ROOT / "tests" / name for name in ("batches", "faults", "fuzz", "hosts", "overload", "replicas", "soak")
}


@pytest.hookimpl(hookwrapper=True)
def pytest_collection():
    yield
    gc.freeze()
    gc.enable()


def pytest_ignore_collect(collection_path, config):
    """Leaves out what `-m "not long"` would import and then deselect."""
    return True if collection_path in _LONG_FOLDERS and "not long" in config.option.markexpr else None


# Fixtures that start processes: tests that use them are `slow`.
_STARTING = {
    "benched",
    "machine",
    "object_server",
    "open_pool",
    "postgres",
    "start_service",
    "start_shared_service",
    "start_worker",
    "wanted",
}


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(items):
    """Tests marked `gpu` are skipped where there is none; tests that start processes are `slow`.

    Files go to the test processes whole and in this order, which is that of pytest-randomly but for two things: those
    with a lengthy test come first, then those with the most tests, so that none is left for the end.
    """
    without_gpu = pytest.mark.skip(reason="there is no CUDA device")
    for item in items:
        if item.get_closest_marker("gpu") and not torch.cuda.is_available():
            item.add_marker(without_gpu)
        if _STARTING.intersection(getattr(item, "fixturenames", ())):
            item.add_marker(pytest.mark.slow)
    tests_of = Counter(item.path for item in items)
    lengthy = {item.path for item in items if item.get_closest_marker("lengthy")}
    items.sort(key=lambda item: (item.path not in lengthy, -tests_of[item.path]))


def pytest_addoption(parser):
    parser.addoption("--record-in", type=Path, help="write when, at which commit and how this run ended to a JSON file")
    parser.addoption("--seed", type=int, help="of what is drawn at random by tests/fuzz; another one in every run")


@pytest.hookimpl(trylast=True)
def pytest_terminal_summary(terminalreporter, exitstatus, config):
    """Writes the file of `--record-in`."""
    path = config.getoption("--record-in")
    if path is None:
        return
    counts = {kind: len(terminalreporter.stats.get(kind, ())) for kind in ("passed", "failed", "error", "skipped")}
    record = {
        "measured": measured(os.cpu_count() or 1),
        "seconds": round(time.monotonic() - BEGAN),
        "exit_status": int(exitstatus),
        **counts,
        "not_passed": sorted(
            report.nodeid for kind in ("failed", "error") for report in terminalreporter.stats.get(kind, ())
        ),
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(record, indent=1) + "\n")


@pytest.fixture(scope="session")
def on_device():
    """A scene where the CUDA backend wants it: on the GPU, or as it is where the kernels are interpreted."""

    def move(scene):
        device = cuda.device()
        return scene if scene.means.device == device else scene.to(device)

    return move


@pytest.fixture
def assert_agrees():
    """Within `tolerance` but for one stable pixel in 10,000, and that one within a flipped threshold."""

    def check(frames, expected, *, tolerance, stable=None):
        for name in PLANES:
            got = getattr(frames, name)
            want = np.asarray(expected[name], dtype=np.float64)
            assert tuple(got.shape) == want.shape
            difference = np.abs(got.cpu().double().numpy() - want)
            if stable is not None:
                difference = difference[stable]
            assert np.isfinite(difference).all(), f"{name} is not finite"
            beyond = difference > tolerance
            assert beyond.sum() <= difference.size / 10_000, (
                f"{name}: {beyond.sum()} of {difference.size} pixels differ by more than {tolerance}, "
                f"the worst by {difference.max():.3g}"
            )
            assert difference.max(initial=0.0) <= LARGEST_FLIP, f"{name}: {difference.max():.3g}"

    return check
