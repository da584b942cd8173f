"""libultragray against the Python library: its C interface, called as an engine calls it."""

import ctypes
import json
import os
import runpy
import zlib
from dataclasses import astuple, replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch

from ultragray import GaussianScene, LinearProbe
from ultragray.contract import from_dict
from ultragray.errors import LowConfidence
from ultragray.exchange.rendering import render_portions
from ultragray.geometry.rotations import random_directions, rotations_of
from ultragray.installation import c_library
from ultragray.phantom.demo import DEMO_FILE
from ultragray.rendering.confidence import SupportWatch
from ultragray.rendering.frames import render_shown
from ultragray.rendering.pixels import in_type
from ultragray.rendering.settings import RenderSettings
from ultragray.scene.confidence import Assessor, require_confidence

from .hostile import hostile_files

IDENTITY = np.eye(4)
PROBE = LinearProbe(width_mm=30.0, near_mm=0.0, far_mm=40.0)
BROWSER_FRAMES = Path(__file__).parents[2] / "browser" / "make_frames.py"
EXACT = [
    {},
    {"encoding": "float32", "outputs": ["bmode", "echo", "transmittance", "coverage", "attenuation"]},
    {"outputs": ["labels", "bmode"], "height": 100, "width": 130},
    {"probe": "C5-2", "height": 90, "width": 75},
    {"probe": "P4-2", "slice_thickness_mm": 2.5, "height": 64, "width": 65, "encoding": "float32"},
    {
        "probe": {"kind": "steered", "width_mm": 40, "steering_deg": 20, "near_mm": 1, "far_mm": 50},
        "encoding": "float32",
    },
    {"display": {"gain_db": 6, "dynamic_range_db": 45, "tgc_db": [0, 3, -2], "depth_mm": 30, "flip": True}},
    {"display": {"gain_db": 6, "edge": 1.5}, "encoding": "float32"},
    {"outputs": ["bmode", "labels", "echo"], "encoding": "float16"},
    {"speckle": "natural", "encoding": "float32"},
    {"speckle": "natural", "probe": "C5-2", "height": 200, "width": 90, "display": {"depth_mm": 120}},
    {"contact": "air", "outputs": ["bmode", "transmittance", "echo", "attenuation"]},
    {"outputs": ["uncertainty", "bmode"], "height": 100, "width": 77},
    {
        "display": {"gain_db_between": [-6, 6], "dynamic_range_db_between": [40, 70], "display_seed": 5},
        "encoding": "float32",
    },
    {"display": {"gain_db_between": [-20, 0], "tgc_db": [0, 4]}},
    {"min_confidence": 0.99, "below_min_confidence": "mask", "outputs": ["bmode", "labels", "coverage", "uncertainty"]},
]
NEEDLE = {"kind": "needle", "tip_mm": [5.0, 0.2, 30.0], "hub_mm": [-25.0, -0.3, 2.0], "frame": "probe"}
ACROSS = {"kind": "needle", "tip_mm": [0.0, 8.0, 20.0], "hub_mm": [1.0, -8.0, 21.0], "frame": "probe", "label": 7}
BOX = {
    "kind": "box",
    "centre_mm": [0.0, 0.0, 25.0],
    "size_mm": [20.0, 10.0, 4.0],
    "quaternion": [0.9, 0.1, 0.42, 0.06],
    "reverberation": 0.0,
}
CYLINDER = {
    "kind": "cylinder",
    "tip_mm": [10.0, 1.0, 35.0],
    "hub_mm": [-15.0, 0.0, 20.0],
    "diameter_mm": 6.0,
    "frame": "probe",
}
ALL = ["bmode", "echo", "transmittance", "coverage", "attenuation"]
PUT_IN = [
    {"tools": [NEEDLE], "outputs": ALL, "height": 120, "width": 110},
    {"tools": [ACROSS, BOX | {"frame": "probe"}], "slice_thickness_mm": 2.0, "height": 90, "width": 100},
    {"tools": [CYLINDER, NEEDLE], "probe": "C9-4", "outputs": ["transmittance", "coverage"]},
    {"tools": [BOX | {"frame": "probe"}], "probe": {"kind": "radial", "near_mm": 2, "far_mm": 40}, "outputs": ["echo"]},
    {"ghost": 0.7, "outputs": ALL, "height": 150, "width": 120},
    {"ghost": 0.4, "tools": [BOX | {"frame": "probe"}], "probe": "P4-2"},
]
INTERPOLATED = [
    {"contact": "pressure", "encoding": "float32", "outputs": ["bmode", "labels"]},
    {"contact": "pressure", "speckle": "natural", "ghost": 0.5, "encoding": "float32", "height": 160, "width": 120},
    {"display": {"pixel_mm": 0.5}, "encoding": "float32"},
    {"probe": {"kind": "radial", "near_mm": 2, "far_mm": 30}, "display": {"pixel_mm": 0.5}, "encoding": "float32"},
    {
        "probe": "C5-2",
        "display": {"pixel_mm": 0.7, "flip": True},
        "encoding": "float32",
        "outputs": ["coverage", "bmode"],
    },
]


PLANES = ("bmode", "echo", "transmittance", "coverage")


class Plan(ctypes.Structure):
    """ultragray_plan."""

    _fields_ = [
        ("axes", ctypes.c_double * 9),
        ("origin", ctypes.c_double * 3),
        *((name, ctypes.c_double) for name in ("near_cm", "row_cm", "most_cm", "start", "span")),
        ("beam", ctypes.c_double * 4),
        *((name, ctypes.c_double) for name in ("fanned", "wrap", "height", "width", *PLANES, "displaced")),
    ]


@cache
def loaded_library():
    path, header = c_library()
    assert header.is_file()
    loaded = ctypes.CDLL(str(path))
    pointer, text, size = ctypes.c_void_p, ctypes.c_char_p, ctypes.c_size_t
    for name, result, arguments in (
        ("load", pointer, (text, size)),
        ("load_part", pointer, (text, size)),
        ("scene_info", text, (pointer,)),
        ("free_scene", None, (pointer,)),
        ("prepare", pointer, (pointer, text)),
        ("view_info", text, (pointer,)),
        ("frame_bytes", size, (pointer,)),
        ("free_view", None, (pointer,)),
        ("render", ctypes.c_int, (pointer, pointer, size, ctypes.c_int, pointer, pointer)),
        ("gaussians", ctypes.POINTER(ctypes.c_float), (pointer, ctypes.POINTER(size))),
        ("harmonics", ctypes.POINTER(ctypes.c_float), (pointer,)),
        ("plan_of", ctypes.c_int, (pointer, pointer, ctypes.POINTER(Plan))),
        ("draw", ctypes.c_int, (pointer, pointer, ctypes.c_int, ctypes.c_int, pointer)),
        ("finish", ctypes.c_int, (pointer, pointer, pointer, ctypes.c_int, pointer, pointer)),
        ("problem", text, ()),
    ):
        function = getattr(loaded, f"ultragray_{name}")
        function.restype, function.argtypes = result, arguments
    return loaded


@pytest.fixture(scope="module")
def library():
    return loaded_library()


class Scene:
    """A scene that the library holds, of a whole file or of the beginning of one."""

    def __init__(self, library, data, load="load"):
        self.library = library
        self.pointer = getattr(library, f"ultragray_{load}")(data, len(data))
        assert self.pointer, self.problem

    @property
    def problem(self):
        return self.library.ultragray_problem().decode()

    def render(self, settings, poses):
        """What it tells of the frames, their bytes [C, bytes], and how far they extrapolate [C, 5]."""
        view = self.library.ultragray_prepare(self.pointer, json.dumps(settings).encode())
        assert view, self.problem
        pixels = np.empty((len(poses), self.library.ultragray_frame_bytes(view)), np.uint8)
        matrices = np.ascontiguousarray(poses, np.float64)
        figures = np.empty((len(poses), 7))
        where = matrices.ctypes.data, len(poses), 2, pixels.ctypes.data, figures.ctypes.data
        code = self.library.ultragray_render(view, *where)
        info = json.loads(self.library.ultragray_view_info(view))
        self.library.ultragray_free_view(view)
        if code != 0:
            raise ValueError(self.problem)
        return info, pixels, figures


@pytest.fixture(scope="module")
def scene(library):
    held = Scene(library, DEMO_FILE.read_bytes())
    yield held
    library.ultragray_free_scene(held.pointer)


@pytest.fixture(scope="module")
def python_scene():
    return GaussianScene.load(DEMO_FILE)


@pytest.fixture(scope="module")
def following_scene(python_scene):
    """The scene, as if its tissue had been dragged along a path that its tracker told with errors."""
    tracked = python_scene.training_poses
    at_rest, errors = tracked.copy(), np.repeat(IDENTITY[None], len(tracked), axis=0)
    at_rest[:, :3, 3] += np.sin(np.arange(len(tracked)) / 3.0)[:, None] * [0.8, 0.0, 0.5]
    errors[:, :3, 3] = np.random.default_rng(2).normal(scale=0.1, size=(len(tracked), 3))
    return GaussianScene.from_splats(
        python_scene.splats,
        info=replace(python_scene.info, tissue_shares=(0.6, 0.3, 1.0)),
        training_poses=tracked,
        labels=python_scene.labels,
        pose_corrections=errors,
        rest_poses=at_rest,
    )


def poses_beside(scene, count):
    """Training poses, shifted and turned by a little."""
    random = np.random.default_rng(3)
    poses = scene.training_poses[:: len(scene.training_poses) // count][:count].copy()
    poses[:, :3, 3] += random.normal(scale=2.0, size=(count, 3))
    return poses


def of_python(python_scene, settings, poses):
    """Each output [C, H, W] of Python, and how far the frames extrapolate; frames of pressed tissue are one by one."""
    asked = from_dict(RenderSettings, settings)
    resolved = asked.resolved(python_scene.info, asked.encoding)
    assessor = Assessor(python_scene.info, python_scene.training_poses)
    frames, figures = [], []
    for pose in poses:
        support = SupportWatch(assessor, assessor.assess(pose, resolved.probe), resolved)
        frames.append(render_shown(python_scene, resolved, pose[None], support=support))
        figures += support.completed(0, 1)
    arrays = {name: np.concatenate([frame[name].numpy() for frame in frames]) for name in resolved.outputs}
    pixel_type = asked.encoding.pixel_type
    return {name: in_type(one, np.uint8 if name == "labels" else pixel_type) for name, one in arrays.items()}, figures


def both(scene, python_scene, settings, poses):
    """Each output [C, H, W] of the library and of Python, which tell of the same picture and the same extrapolation."""
    asked = from_dict(RenderSettings, settings)
    picture = asked.resolved(python_scene.info, asked.encoding).picture
    shown, extrapolations = of_python(python_scene, settings, poses)
    info, pixels, figures = scene.render(settings, poses)
    assert (info["height"], info["width"]) == (picture.height, picture.width)
    assert info["picture"]["first"] == pytest.approx(picture.first)
    assert info["picture"]["step"] == pytest.approx(picture.step)
    told = [[np.nan if one is None else one for one in astuple(frame)] for frame in extrapolations]
    np.testing.assert_allclose(figures, told, rtol=1e-6, atol=5e-6)  # the angle's cosine is near 1
    at = 0
    for expected in shown.values():
        part = pixels[:, at : at + expected[0].nbytes]
        at += expected[0].nbytes
        yield part.copy().view(expected.dtype).reshape(expected.shape), expected
    assert at == pixels.shape[1]


@pytest.mark.parametrize("settings", EXACT, ids=json.dumps)
def test_frames_are_those_of_python_byte_for_byte(scene, python_scene, settings):
    for found, expected in both(scene, python_scene, settings, poses_beside(python_scene, 3)):
        assert expected.any()
        np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("settings", [*EXACT, *PUT_IN], ids=json.dumps)
def test_planes_drawn_by_a_plan_become_the_frame(scene, python_scene, settings):
    """The planes are those of the view without tools, ghosts and display settings."""
    library = scene.library
    view = library.ultragray_prepare(scene.pointer, json.dumps(settings).encode())
    [pose], plan = poses_beside(python_scene, 1), Plan()
    pose = np.ascontiguousarray(pose)
    assert library.ultragray_plan_of(view, pose.ctypes.data, plan) == 0, scene.problem
    wanted = [name for name in PLANES if getattr(plan, name)]
    plain = {name: settings[name] for name in ("probe", "slice_thickness_mm") if name in settings}
    size = {"height": int(plan.height), "width": int(plan.width)}
    _, planes, _ = scene.render(plain | size | {"outputs": wanted, "encoding": "float32"}, pose[None])
    _, expected, extrapolation = scene.render(settings, pose[None])
    found, told = np.zeros_like(expected), np.zeros_like(extrapolation)
    where = pose.ctypes.data, planes.ctypes.data, 1, found.ctypes.data, told.ctypes.data
    code = library.ultragray_finish(view, *where)
    library.ultragray_free_view(view)
    assert code == 0, scene.problem
    np.testing.assert_array_equal(found, expected)
    np.testing.assert_array_equal(told, extrapolation)


@pytest.mark.parametrize("probe", ["L7-4", "C5-2", {"kind": "radial", "near_mm": 2, "far_mm": 40}])
def test_scan_lines_drawn_in_shares_are_the_planes_to_the_bit(scene, python_scene, probe):
    height, width = 70, 150
    settings = {"probe": probe, "height": height, "width": width, "outputs": list(PLANES), "encoding": "float32"}
    poses = poses_beside(python_scene, 1)
    _, whole, _ = scene.render(settings, poses)
    view = scene.library.ultragray_prepare(scene.pointer, json.dumps(settings).encode())
    shares = []
    for first, end in ((0, 64), (64, 128), (128, width)):
        planes = np.empty((len(PLANES), height, end - first), np.float32)
        assert scene.library.ultragray_draw(view, poses.ctypes.data, first, end, planes.ctypes.data) == 0
        shares.append(planes)
    np.testing.assert_array_equal(np.concatenate(shares, axis=2).ravel(), whole.view(np.float32).ravel())
    assert scene.library.ultragray_draw(view, poses.ctypes.data, 64, 130, planes.ctypes.data) != 0
    assert scene.problem.endswith("from one multiple of 64 to another or to the last, got 64 to 130")
    scene.library.ultragray_free_view(view)


def test_the_geometry_of_a_plan_is_the_pose_and_the_probe(scene, python_scene):
    settings = {"probe": {"kind": "steered", "width_mm": 40, "steering_deg": 20, "near_mm": 5, "far_mm": 45}}
    view = scene.library.ultragray_prepare(scene.pointer, json.dumps(settings | {"height": 80, "width": 10}).encode())
    pose, plan = np.ascontiguousarray(python_scene.training_poses[3]), Plan()
    assert scene.library.ultragray_plan_of(view, pose.ctypes.data, plan) == 0
    scene.library.ultragray_free_view(view)
    axes, centre = np.array(plan.axes).reshape(3, 3), np.array(python_scene.info.centre_mm)
    angle = np.radians(20.0)  # lateral and axial become those along which a steered line is upright
    np.testing.assert_allclose(axes[0], pose[:3, 0] - np.tan(angle) * pose[:3, 2], atol=1e-6)
    np.testing.assert_allclose(axes[1], pose[:3, 1], atol=1e-6)
    np.testing.assert_allclose(axes[2], pose[:3, 2] / np.cos(angle), atol=1e-6)
    np.testing.assert_allclose(plan.origin, (pose[:3, 3] - centre) / 10.0, atol=1e-6)
    assert (plan.near_cm, plan.row_cm, plan.most_cm) == pytest.approx((0.5, 0.05, 4.45))
    assert (plan.start, plan.span, plan.fanned, plan.wrap) == pytest.approx((-2.0, 4.0, 0.0, 0.0))


def test_gaussians_are_those_of_the_scene(scene, python_scene):
    count, terms = len(python_scene.means), python_scene.shN.shape[1] + 1
    found = ctypes.c_size_t()
    gaussians = np.ctypeslib.as_array(scene.library.ultragray_gaussians(scene.pointer, found), (count, 12))
    assert found.value == count
    harmonics = np.ctypeslib.as_array(scene.library.ultragray_harmonics(scene.pointer), (count, terms))
    means = python_scene.means.numpy()
    order, given = np.lexsort(gaussians[:, :3].T), np.lexsort(means.T)
    np.testing.assert_array_equal(gaussians[order, :3], means[given])
    np.testing.assert_allclose(gaussians[order, 3:6], np.exp(python_scene.scales.numpy()[given]), rtol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(gaussians[:, 6:10], axis=1), 1.0, rtol=1e-5)
    absorb = 1.0 / (1.0 + np.exp(python_scene.transmittances.numpy()[given]))
    np.testing.assert_allclose(gaussians[order, 10], absorb, rtol=1e-5)
    np.testing.assert_array_equal(harmonics[order, 0], python_scene.sh0.numpy()[given].ravel())


@pytest.mark.parametrize("settings", INTERPOLATED, ids=json.dumps)
def test_scan_converted_frames_are_as_near_as_float32_is(scene, python_scene, settings):
    for found, expected in both(scene, python_scene, settings, poses_beside(python_scene, 2)):
        assert expected.any()
        np.testing.assert_allclose(found, expected, atol=2e-5)


@pytest.mark.parametrize("settings", PUT_IN, ids=json.dumps)
def test_tools_and_the_second_echo_are_as_near_as_float32_is(scene, python_scene, settings):
    poses = poses_beside(python_scene, 2)
    changed = 0
    asked = settings | {"encoding": "float32"}
    plain = {name: value for name, value in asked.items() if name not in ("tools", "ghost")}
    for (found, expected), (without, _) in zip(
        both(scene, python_scene, asked, poses), both(scene, python_scene, plain, poses), strict=True
    ):
        apart = np.abs(found - expected)
        assert np.mean(apart > 1e-4) < 1e-3  # a row at the edge of a body, or of an interface, may fall to either side
        assert np.median(apart) < 1e-6
        changed += np.count_nonzero(found != without)
    assert changed > 100


def random_request(random, scene):
    """A pose about the sweep, and settings with whatever the library can render."""
    pose = scene.training_poses[random.integers(len(scene.training_poses))].copy()
    pose[:3, :3] = pose[:3, :3] @ rotations_of(0.3 * random.normal() * random_directions(random, 1))[0]
    pose[:3, 3] += random.normal(scale=5.0, size=3)
    settings = runpy.run_path(str(BROWSER_FRAMES))["random_settings"](random)
    settings["encoding"] = str(random.choice(["uint8", "float32", "float16"]))
    settings["outputs"] += [str(one) for one in random.choice(["labels", "attenuation", "uncertainty"], size=1)]
    if random.random() < 0.3:
        settings |= {"min_confidence": float(random.uniform(0.2, 1.0)), "below_min_confidence": "mask"}
    if random.random() < 0.3 and (tools := settings.get("tools")):
        tools += [CYLINDER, BOX | {"frame": "probe"}]
    if display := settings.get("display"):
        if random.random() < 0.3:
            display |= {"gain_db_between": [-6.0, 3.0], "display_seed": int(random.integers(2**53))}
        if random.random() < 0.3:
            display |= {"dynamic_range_db_between": [40.0, 80.0]}
        if random.random() < 0.3:
            display |= {"depth_mm": float(random.uniform(5.0, 70.0))}
        if random.random() < 0.3:
            display |= {"pixel_mm": float(random.uniform(0.3, 2.0))}
    return settings, pose


@pytest.mark.parametrize("seed", range(int(os.environ.get("ULTRAGRAY_TEST_LIBRARY_FRAMES", "24"))))
def test_random_frames_are_those_of_python(scene, python_scene, seed):
    settings, pose = random_request(np.random.default_rng(seed), python_scene)
    display = settings.get("display", {})
    rounded = bool({"tools", "ghost"} & set(settings)) or "pixel_mm" in display or settings.get("contact") == "pressure"
    enlarged = (1.0 + 2.0 * display.get("edge", 0.0)) * 2.0  # by edges, and by a small dynamic range
    outputs = from_dict(RenderSettings, settings).outputs
    for name, (found, expected) in zip(outputs, both(scene, python_scene, settings, pose[None]), strict=True):
        if not rounded and name != "uncertainty":
            np.testing.assert_array_equal(found, expected)
            continue
        apart = np.abs(found.astype(np.float64) - expected)
        step = {"u1": 1.0, "f4": 1e-4 * enlarged, "f2": 1e-3 * enlarged}[expected.dtype.str[1:]]
        flips = apart > (0.0 if name == "labels" else step)
        assert flips.sum() <= 2 * max(flips.shape[1:])  # a row at the edge of a body may fall to either side


def test_tools_have_labels_in_every_scene(scene, python_scene):
    poses = poses_beside(python_scene, 2)
    settings = {"outputs": ["labels"], "tools": [NEEDLE, ACROSS], "height": 200, "width": 200}
    for found, expected in both(scene, python_scene, settings, poses):
        assert np.mean(found != expected) < 1e-4
        assert {7, 255} <= set(np.unique(found).tolist())


def test_poses_lead_into_tissue_that_followed_the_probe(library, following_scene):
    poses = poses_beside(following_scene, 4)
    held = Scene(library, following_scene.to_bytes())
    for found, expected in both(held, following_scene, {"height": 80, "width": 90}, poses):
        np.testing.assert_array_equal(found, expected)
    rigid = Scene(library, following_scene.at_rest().to_bytes())
    assert not np.array_equal(rigid.render({"height": 80, "width": 90}, poses)[1], found.reshape(len(poses), -1))


@pytest.mark.parametrize("sh_degree", range(4))
def test_compressed_scenes_are_read_as_python_reads_them(library, random_scene, tmp_path, sh_degree):
    scene = random_scene(500, sh_degree=sh_degree, seed=sh_degree, intensity="sigmoid", info={"probe": PROBE})
    scene.labels, scene.info = torch.arange(500).to(torch.uint8), replace(scene.info, label_names={1: "one"})
    scene = scene if sh_degree else replace(scene, labels=None, info=replace(scene.info, label_names={}))
    scene.save(tmp_path / "scene.ugz")
    held, read = Scene(library, (tmp_path / "scene.ugz").read_bytes()), GaussianScene.load(tmp_path / "scene.ugz")
    outputs = [*ALL, "labels"] if sh_degree else ALL
    settings = {"encoding": "float32", "outputs": outputs, "height": 90, "width": 80}
    for found, expected in both(held, read, settings, np.tile(IDENTITY, (1, 1, 1))):
        assert expected.any()
        np.testing.assert_array_equal(found, expected)


def compressed_and_ends(scene):
    """A scene, compressed, and where the parts of the file end."""
    data = scene.to_compressed_bytes()
    begin = 8 + int.from_bytes(data[:8], "little")
    header = json.loads(data[8:begin])
    ends = sorted(begin + one["data_offsets"][1] for name, one in header.items() if name.startswith("part."))
    return data, ends


@pytest.fixture(scope="module")
def compressed(python_scene):
    return compressed_and_ends(python_scene)


def test_the_beginning_of_a_compressed_scene_is_a_coarser_scene(library, scene, python_scene, compressed):
    data, ends = compressed
    assert ends[-1] == len(data)
    counts = [
        json.loads(library.ultragray_scene_info(Scene(library, data[:end], "load_part").pointer))["gaussian_count"]
        for end in ends
    ]
    assert counts == [0.1 * 50_000, 0.3 * 50_000, 0.6 * 50_000, 50_000]
    settings, poses = {"encoding": "float32", "height": 128, "width": 128}, poses_beside(python_scene, 3)
    whole = scene.render(settings, poses)[1].view(np.float32)
    errors = []
    for end in ends:
        for cut in (end, (end + ends[ends.index(end) + 1]) // 2 if end < ends[-1] else end):  # and what follows in half
            part = Scene(library, data[:cut], "load_part").render(settings, poses)[1].view(np.float32)
            errors.append(np.square(part - whole).mean())
    assert errors[0:-1:2] == errors[1::2]
    assert sorted(errors, reverse=True) == errors
    assert errors[0] < np.square(whole - whole.mean()).mean()
    assert errors[-1] < 2e-6
    np.testing.assert_array_equal(Scene(library, data).render(settings, poses)[1].view(np.float32), part)


def test_what_is_no_beginning_of_a_compressed_scene_is_one_sentence(library, compressed):
    data, ends = compressed
    for bytes_, problem in (
        (data[:3000], "it is cut off: its header tells of more"),
        (data[:20_000], "it is cut off: its header tells of more"),
        (data[: ends[0] - 1], "it is cut off: its header tells of more"),
        (DEMO_FILE.read_bytes()[:100_000], "only compressed scene files (.ugz) can be read in parts"),
    ):
        assert not library.ultragray_load_part(bytes_, len(bytes_))
        assert library.ultragray_problem().decode() == problem
    assert not library.ultragray_load(data, ends[0])
    assert library.ultragray_problem().decode() == "it is cut off: its header tells of more"


def test_hostile_parts_are_one_sentence(library, python_scene):
    """Of the same size and with the right checksum, but other bytes: refused, or read; never a crash."""
    tenth = {name: tensor[::10] for name, tensor in python_scene.splats.items()}
    labels = python_scene.labels[::10]
    data, ends = compressed_and_ends(GaussianScene.from_splats(tenth, info=python_scene.info, labels=labels))
    begin = data.index(data[ends[-2] : ends[-2] + 64])
    random = np.random.default_rng(6)
    problems = set()
    for turn in range(300):
        part = bytearray(data[begin:])
        span = 300 if turn % 2 else len(part) - 4  # head and table, or anywhere
        for place in random.integers(0, span, size=random.integers(1, 4)):
            part[place] = random.integers(0, 256)
        if turn % 3:
            part[-4:] = zlib.crc32(part[:-4]).to_bytes(4, "little")
        one = data[:begin] + bytes(part)
        pointer = library.ultragray_load(one, len(one))
        if pointer:
            library.ultragray_free_scene(pointer)
        else:
            problems.add(library.ultragray_problem().decode())
    assert {
        "its part.03 is damaged: its checksum differs",
        "its part.03 has a head that it cannot have",
        "its part.03 is not of the size that its head says",
    } <= problems


def test_a_view_outlives_its_scene(library, python_scene):
    data = DEMO_FILE.read_bytes()
    pointer = library.ultragray_load(data, len(data))
    view = library.ultragray_prepare(pointer, None)
    library.ultragray_free_scene(pointer)
    pose = np.ascontiguousarray(python_scene.training_poses[0])
    pixels = np.zeros(library.ultragray_frame_bytes(view), np.uint8)
    assert library.ultragray_render(view, pose.ctypes.data, 1, 1, pixels.ctypes.data, None) == 0
    assert pixels.any()
    library.ultragray_free_view(view)


def test_what_a_scene_does_not_know_is_refused_in_a_sentence(library, python_scene):
    info = replace(python_scene.info, confidence={}, speckle=None, probe=None)
    bare = Scene(library, replace(python_scene, info=info).to_bytes())
    for asked, problem in (
        ({"min_confidence": 0.5}, "min_confidence needs a scene that knows the confidence of its frames"),
        ({"outputs": ["uncertainty"]}, "outputs may name uncertainty only for a scene whose training fitted"),
        ({"speckle": "natural"}, "speckle natural needs a scene whose training fitted the speckle of its frames"),
        ({"contact": "air"}, "contact needs a scene that knows its training poses and their probe"),
    ):
        settings = json.dumps(asked | {"probe": "L7-4"}).encode()
        assert library.ultragray_prepare(bare.pointer, settings) is None
        assert problem in bare.problem


def render_as_the_service(python_scene, resolved, pose):
    assessed = Assessor(python_scene.info, python_scene.training_poses).assess(pose, resolved.probe)
    require_confidence(assessed, resolved.least_confidence)
    return list(render_portions(python_scene, resolved, pose[None], assessed))


def test_frames_below_the_least_confidence_are_refused_as_python_refuses_them(scene, python_scene):
    beside = python_scene.training_poses[100].copy()
    assert scene.render({"min_confidence": 0.9}, beside[None])[2][0, 2] > 0.9
    beside[0, 3] += 15.0
    for least in (0.9, 0.8):  # more than the pose alone promises, and than its frame turns out to have
        settings = {"min_confidence": least, "height": 60, "width": 60}
        asked = from_dict(RenderSettings, settings)
        resolved = asked.resolved(python_scene.info, asked.encoding)
        with pytest.raises(LowConfidence) as refusal:
            render_as_the_service(python_scene, resolved, beside)
        with pytest.raises(ValueError, match="has a confidence of") as told:
            scene.render(settings, beside[None])
        assert str(told.value) == str(refusal.value)


@pytest.mark.parametrize(
    ("settings", "problem"),
    [
        ("[", "the settings are no JSON"),
        ('{"height": 0}', "height must be an integer from 1 to 4096, got 0"),
        ('{"heigth": 10}', "heigth is not a known key"),
        ('{"probe": {"kind": "linear", "near_mm": 0, "far_mm": 50}}', "probe.width_mm is required by the probe linear"),
        (
            '{"probe": {"kind": "cone"}}',
            "probe.kind must be one of convex, linear, phased, radial, steered, got 'cone'",
        ),
        ('{"display": {"gain_db": 300}}', "display.gain_db must be a finite number from -100 to 100, got 300"),
        ('{"display": {"pixel_mm": 0.002}}', "at most 4096 pixels on a side"),
        ('{"outputs": ["sound"]}', "outputs must be some of bmode, "),
        ('{"encoding": "png"}', "encoding must be uint8, float32 or float16 for local frames"),
        ('{"registration": "table"}', "registration is kept by a service"),
    ],
)
def test_wrong_settings_are_one_sentence(scene, settings, problem):
    assert scene.library.ultragray_prepare(scene.pointer, settings.encode()) is None
    assert problem in scene.problem


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (lambda pose: pose * 2.0, "must end in the row 0 0 0 1"),
        (lambda pose: pose * np.array([[1.2], [1.2], [1.2], [1.0]]), "must hold a rotation: the largest entry"),
        (lambda pose: np.diag([-1.0, 1.0, 1.0, 1.0]) @ pose, "determinant +1"),
        (lambda pose: pose + np.nan, "must be finite"),
        (lambda pose: pose + np.outer([2e6, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]), "must lie within 1e+06 mm"),
    ],
)
def test_wrong_poses_are_one_sentence(scene, change, problem):
    view = scene.library.ultragray_prepare(scene.pointer, b'{"height": 8, "width": 8}')
    pose = np.ascontiguousarray(change(IDENTITY))
    pixels = np.zeros(64, np.uint8)
    assert scene.library.ultragray_render(view, pose.ctypes.data, 1, 1, pixels.ctypes.data, None) != 0
    assert scene.problem.startswith("poses[0] must")
    assert problem in scene.problem
    scene.library.ultragray_free_view(view)


def test_hostile_scene_files_are_one_sentence(library, python_scene):
    """Refused in words, or read, and then rendered with all that the file describes or refused; never a crash."""
    data = small(python_scene, 300).to_bytes()
    pose = np.ascontiguousarray(python_scene.training_poses[0])
    asked = {"height": 9, "width": 9, "contact": "pressure", "speckle": "natural", "outputs": ["bmode", "uncertainty"]}
    refused = 0
    for one in (*hostile_files(data, 600, seed=5), os.urandom(5000)):
        pointer = library.ultragray_load(one, len(one))
        view = library.ultragray_prepare(pointer, json.dumps(asked).encode()) if pointer else None
        if view:
            pixels = np.zeros(library.ultragray_frame_bytes(view), np.uint8)
            library.ultragray_render(view, pose.ctypes.data, 1, 1, pixels.ctypes.data, None)
            library.ultragray_free_view(view)
        else:
            refused += 1
            assert len(library.ultragray_problem()) > 10
        library.ultragray_free_scene(pointer)
    assert refused > 100
    for one in (data[:5], data[:100], data[:-1]):
        assert not library.ultragray_load(one, len(one))
        assert "cut off" in library.ultragray_problem().decode()
    depth = 500_000
    nested = json.dumps(
        {"__metadata__": {"ultragray": '{"format_version": 1, "probe": ' + depth * "[" + depth * "]" + "}"}}
    )
    deep = len(nested).to_bytes(8, "little") + nested.encode()
    assert not library.ultragray_load(deep, len(deep))
    assert library.ultragray_problem().decode() == (
        "probe must be an object with a kind, one of convex, linear, phased, radial, steered, got a list of 1 values"
    )


def small(scene, count):
    """The first Gaussians of a scene, as a scene."""
    return GaussianScene.from_splats(
        {name: values[:count] for name, values in scene.splats.items()},
        info=replace(scene.info, gaussian_count=count),
        training_poses=scene.training_poses,
        labels=scene.labels[:count],
    )


def test_a_thousand_scenes_leave_no_memory_behind(library, python_scene):
    data, pose = small(python_scene, 1000).to_bytes(), python_scene.training_poses[:1]
    settings = {"height": 16, "width": 16, "outputs": ["bmode", "labels", "uncertainty"]}

    def load_and_free(times):
        for _ in range(times):
            held = Scene(library, data)
            held.render(settings, pose)
            library.ultragray_free_scene(held.pointer)
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")

    before = load_and_free(20)
    assert load_and_free(1000) - before < 2e6  # two kilobytes of each would be seen
