"""libultragray built without Python: under sanitizers, and for arm64, whose vectors are NEON, run by QEMU."""

import json
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from ultragray import GaussianScene
from ultragray.contract import from_dict
from ultragray.phantom.demo import DEMO_FILE
from ultragray.rendering.frames import render_shown
from ultragray.rendering.settings import RenderSettings

from .hostile import hostile_files

ROOT = Path(__file__).parents[3]
DRIVER = Path(__file__).with_name("render.c")
SETTINGS = [
    {"encoding": "float32", "outputs": ["bmode", "coverage"], "height": 96, "width": 80},
    {"encoding": "float32", "probe": "C5-2", "slice_thickness_mm": 2.0, "height": 60, "width": 50},
    {"encoding": "float32", "height": 40, "width": 44, "display": {"gain_db": 4, "pixel_mm": 1.0}, "ghost": 0.5},
    {"encoding": "float32", "height": 70, "width": 50, "contact": "pressure", "outputs": ["bmode", "uncertainty"]},
    {"encoding": "float32", "height": 60, "width": 50, "speckle": "natural", "display": {"gain_db_between": [-9, 3]}},
]
ARM = "aarch64-linux-gnu"
pytestmark = pytest.mark.long


def needs(*programs):
    missing = [one for one in programs if shutil.which(one) is None]
    if missing or not Path("/usr/include/nlohmann/json.hpp").is_file():
        pytest.skip(f"needs Debian's nlohmann-json3-dev, and {', '.join(programs)}")


def build(folder, compiler, flags, cmake):
    """The driver, linked to a library of its own."""
    subprocess.run(
        ["cmake", "-S", ROOT, "-B", folder, "-DULTRAGRAY_PYTHON=OFF", f"-DCMAKE_CXX_FLAGS={flags}", *cmake],
        check=True,
        capture_output=True,
    )
    subprocess.run(["cmake", "--build", folder, "--parallel", "2"], check=True, capture_output=True)
    driver = folder / "render"
    library = ["-L", folder, "-lultragray", f"-Wl,-rpath,{folder}", "-I", ROOT / "model" / "library"]
    subprocess.run([compiler, *flags.split(), "-Wall", "-Wextra", DRIVER, *library, "-o", driver], check=True)
    return driver


@pytest.fixture(scope="module")
def sanitized(tmp_path_factory):
    needs("cmake", "cc")
    flags = "-fsanitize=address,undefined -fno-sanitize-recover=all -g"
    return [build(tmp_path_factory.mktemp("sanitized"), "cc", flags, ["-DCMAKE_BUILD_TYPE=None"])]


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    needs("cmake", f"{ARM}-g++", "qemu-aarch64")
    machine = ["-DCMAKE_SYSTEM_NAME=Linux", "-DCMAKE_SYSTEM_PROCESSOR=aarch64", f"-DCMAKE_CXX_COMPILER={ARM}-g++"]
    driver = build(tmp_path_factory.mktemp("arm"), f"{ARM}-gcc", "", ["-DCMAKE_BUILD_TYPE=Release", *machine])
    return ["qemu-aarch64", "-L", f"/usr/{ARM}", "-E", f"LD_LIBRARY_PATH={driver.parent}", driver]


def run(command, scene, settings, poses, folder):
    (folder / "poses").write_bytes(np.ascontiguousarray(poses).tobytes())
    words = [*command, scene, json.dumps(settings), folder / "poses", folder / "out"]
    return subprocess.run(words, capture_output=True, text=True)


def check_frames(command, folder):
    scene = GaussianScene.load(DEMO_FILE)
    poses = scene.training_poses[::90][:2]
    for settings in SETTINGS:
        ran = run(command, DEMO_FILE, settings, poses, folder)
        assert ran.returncode == 0, ran.stderr
        asked = from_dict(RenderSettings, settings)
        resolved = asked.resolved(scene.info, asked.encoding)
        shown = render_shown(scene, resolved, poses)
        expected = np.concatenate([shown[name].numpy().reshape(len(poses), -1) for name in resolved.outputs], axis=1)
        found = np.frombuffer((folder / "out").read_bytes(), "<f4").reshape(expected.shape)
        apart = np.abs(found - expected)
        assert expected.any()
        assert apart.max() < 1.0 / 255.0  # a Gaussian that just reaches so much for one of the two
        assert np.mean(apart > 5e-4) < 1e-4


def test_frames_on_arm64_are_those_of_this_machine(arm, tmp_path):
    check_frames(arm, tmp_path)


def test_frames_leave_no_finding_of_the_sanitizers(sanitized, tmp_path):
    check_frames(sanitized, tmp_path)


def test_hostile_files_and_settings_leave_no_finding(sanitized, tmp_path):
    for one in hostile_files(DEMO_FILE.read_bytes(), 60, seed=11):
        (tmp_path / "scene").write_bytes(one)
        for settings in SETTINGS[-2:]:
            ran = run(sanitized, tmp_path / "scene", settings, np.eye(4)[None], tmp_path)
            assert ran.returncode in (0, 1), ran.stderr  # a sanitizer ends with another
            assert ran.returncode == 0 or ran.stderr.count("\n") == 1
    for settings in ({"tools": [{}] * 9}, {"display": {"tgc_db": [1e9]}}, {"height": 1e99}, [], {"probe": {"kind": 3}}):
        ran = run(sanitized, DEMO_FILE, settings, np.eye(4)[None], tmp_path)
        assert (ran.returncode, ran.stderr.count("\n")) == (1, 1), ran.stderr
