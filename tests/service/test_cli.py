"""The command line: real files in, real files out; a mistake gives one line and exit code 2."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
import pytest
import torch
from typer.testing import CliRunner, Result

import ultragray
from ultragray import ConvexProbe, GaussianScene, LinearProbe, PhasedProbe, SceneInfo, cpu, render
from ultragray.confidence import FIGURES, Assessor, ConfidenceModel, figure_arrays
from ultragray.datasets.plus import read_plus_sweep
from ultragray.demo import DEMO_FILE
from ultragray.errors import InvalidArgument, SceneFileInvalid
from ultragray.files import file_sha256
from ultragray.samplers import FanSampler
from ultragray_service import cli_render
from ultragray_service.cli import app
from ultragray_service.cli_serve import ensure_scenes, link_scenes
from ultragray_service.settings import Settings

LINEAR = LinearProbe(width_mm=30.0, near_mm=0.0, far_mm=40.0)
CONVEX = ConvexProbe(opening_angle_deg=60.0, near_mm=10.0, far_mm=50.0)
PHASED = PhasedProbe(opening_angle_deg=90.0, far_mm=50.0)
CONVEX_JSON = '{"kind": "convex", "opening_angle_deg": 60, "near_mm": 10, "far_mm": 50}'

COMMANDS = (
    "serve",
    "render",
    "info",
    "dataset",
    "jobs",
    "train",
    "eval",
    "compound",
    "report",
    "export",
    "import-ply",
    "import-checkpoint",
    "demo",
    "bench",
)


def run(*arguments: object) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def refused(*arguments: object) -> str:
    """The one line that a mistake gives."""
    result = run(*arguments)
    assert result.exit_code == 2, result.output
    assert "Traceback" not in result.output
    assert result.stderr.startswith("error: ")
    assert result.stderr.count("\n") == 1
    return result.stderr


def python(program: str, *arguments: object) -> list[str]:
    """A command for a fresh process that finds the packages as this one does."""
    return [sys.executable, "-c", f"import sys; sys.path[:0] = {sys.path!r}; {program}", *map(str, arguments)]


@pytest.fixture
def scene_file(tmp_path: Path, random_scene: Callable[..., GaussianScene], random_poses: Callable[..., Any]) -> Path:
    info = {"centre_mm": (1.0, 2.0, 3.0), "probe": LINEAR, "image_height": 24, "image_width": 20}
    made = random_scene(60, info=info)
    path = tmp_path / "scene.ugr"
    GaussianScene.from_splats(made.splats, info=made.info, training_poses=random_poses(5)).save(path)
    return path


@pytest.fixture
def pose_file(tmp_path: Path, random_poses: Callable[..., Any]) -> Path:
    path = tmp_path / "poses.npy"
    np.save(path, random_poses(7, seed=3))
    return path


def test_help_is_instant_it_imports_nothing_heavy() -> None:
    program = (
        "from ultragray_service.cli import app; app(standalone_mode=False); "
        "print(sorted({'torch', 'fastapi', 'grpc', 'cv2', 'uvicorn'} & set(sys.modules)))"
    )
    answer = subprocess.run(python(program, "--help"), capture_output=True, text=True, check=True)
    for command in COMMANDS:
        assert re.search(rf"\b{command}\b", answer.stdout)
    assert answer.stdout.splitlines()[-1] == "[]"


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_explains_itself(command: str) -> None:
    result = run(command, "--help")
    assert result.exit_code == 0
    assert "Usage" in result.output


def test_version() -> None:
    assert run("--version").output.strip() == f"ultragray {ultragray.__version__}"


def test_the_defaults_that_serve_names_are_those_of_the_settings() -> None:
    import typer

    options = {p.name: p for p in typer.main.get_command(app).commands["serve"].params}  # type: ignore[attr-defined]
    for name, option in options.items():
        field = "threads_per_process" if name == "threads" else name
        if field in Settings.model_fields:
            default = Settings.model_fields[field].default
            assert option.show_default == ("off" if default is None else str(default))
            assert f"ULTRAGRAY_{field.upper()}" in option.help


def test_render_writes_an_npz_that_can_be_replayed(scene_file: Path, pose_file: Path, tmp_path: Path) -> None:
    output = tmp_path / "frames.npz"
    result = run(
        *("render", scene_file, "--poses", pose_file, "--height", 16, "--width", 12),
        *("--outputs", "bmode,transmittance", "-o", output),
    )
    assert result.exit_code == 0, result.output
    assert "7 frames of 16x12" in result.output
    with np.load(output) as frames:
        assert set(frames) == {"bmode", "transmittance", "poses", *FIGURES, "scene", "scene_sha256", "renderer"}
        assert str(frames["scene"]) == "scene"
        assert str(frames["scene_sha256"]) == file_sha256(scene_file)
        assert str(frames["renderer"]) == f"ultragray/{ultragray.__version__} cpu-{cpu.INSTRUCTION_SETS[0]}"
        again = render(GaussianScene.load(scene_file), None, frames["poses"], height=16, width=12)
        for name in ("bmode", "transmittance"):
            assert frames[name].dtype == np.float32
            assert frames[name].max() > 0.05
            np.testing.assert_allclose(frames[name], getattr(again, name).numpy(), atol=1e-6)


def test_chunks_do_not_show(scene_file: Path, pose_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole, chunked = tmp_path / "whole.npz", tmp_path / "chunked.npz"
    arguments = ("render", scene_file, "--poses", pose_file, "--outputs", "bmode,echo,coverage", "-o")
    assert run(*arguments, whole).exit_code == 0
    sizes: list[int] = []

    def counting(scene: Any, probe: Any, poses: Any, **options: Any) -> Any:
        sizes.append(len(poses))
        return render(scene, probe, poses, **options)

    monkeypatch.setattr(cli_render, "render", counting)
    monkeypatch.setattr(cli_render, "CHUNK_BYTES", 3 * 4 * 24 * 20 * 3)
    assert run(*arguments, chunked).exit_code == 0
    assert sizes == [3, 3, 1]
    with np.load(whole) as first, np.load(chunked) as second:
        for name in first:
            np.testing.assert_array_equal(first[name], second[name])
    assert sorted(p.name for p in tmp_path.iterdir()) == ["chunked.npz", "poses.npy", "scene.ugr", "whole.npz"]


def test_without_poses_the_training_views_are_rendered_as_trained(scene_file: Path, tmp_path: Path) -> None:
    assert run("render", scene_file, "-o", tmp_path / "f.npz").exit_code == 0
    with np.load(tmp_path / "f.npz") as frames:
        assert frames["bmode"].shape == (5, 24, 20)


def test_render_writes_pngs(scene_file: Path, tmp_path: Path) -> None:
    folder, npz = tmp_path / "pictures", tmp_path / "f.npz"
    arguments = ("render", scene_file, "--outputs", "bmode,coverage", "-o")
    assert run(*arguments, folder).exit_code == 0
    assert run(*arguments, npz).exit_code == 0
    names = sorted(p.name for p in folder.iterdir())
    pictures = [f"frame_{i:05d}_{output}.png" for i in range(5) for output in ("bmode", "coverage")]
    assert names == [*pictures, "frames.json"]
    with np.load(npz) as frames:
        for output in ("bmode", "coverage"):
            picture = cv2.imread(str(folder / f"frame_00003_{output}.png"), cv2.IMREAD_UNCHANGED)
            np.testing.assert_array_equal(picture, np.rint(frames[output][3] * 255))


@pytest.fixture
def knowing_file(scene_file: Path, tmp_path: Path) -> Path:
    """The scene with a model of its confidence."""
    scene = GaussianScene.load(scene_file)
    model = ConfidenceModel((3.5, 1.2, 0.8, 0.1, 0.6), 0.06, (0.125,) * 5, 20, 0.04)
    replace(scene, info=replace(scene.info, confidence=model.to_dict())).save(tmp_path / "knowing.ugr")
    return tmp_path / "knowing.ugr"


def test_render_tells_and_stores_how_far_frames_extrapolate(
    knowing_file: Path, scene_file: Path, tmp_path: Path
) -> None:
    scene = GaussianScene.load(knowing_file)
    coverage = render(scene, None, scene.training_poses, height=24, width=20, outputs=("coverage",)).coverage
    assert coverage is not None
    expected = Assessor(scene.info, scene.training_poses).assess(scene.training_poses, coverage=coverage.numpy())
    figures = figure_arrays(expected)
    low, high = figures["confidence"].min(), figures["confidence"].max()
    share = f"Gaussians support {figures['supported_share'].mean():.0%} of the pixels"

    result = run("render", knowing_file, "-o", tmp_path / "pictures")
    assert result.output.endswith(f"; confidence {low:.2f} to {high:.2f}, {share}\n")
    told = json.loads((tmp_path / "pictures" / "frames.json").read_text())
    assert [one["frame"] for one in told] == [0, 1, 2, 3, 4]
    for one, extrapolation, pose in zip(told, expected, scene.training_poses, strict=True):
        assert {name: one[name] for name in FIGURES} == pytest.approx(asdict(extrapolation))
        assert one["pose"] == pose.tolist()

    assert run("render", scene_file, "-o", tmp_path / "f.npz").output.endswith(f" s; {share}\n")
    with np.load(tmp_path / "f.npz") as frames:
        np.testing.assert_allclose(frames["supported_share"], figures["supported_share"])
        np.testing.assert_allclose(frames["angle_deg"], figures["angle_deg"], rtol=1e-6)
        assert np.isnan(frames["confidence"]).all()


def test_render_keeps_to_a_least_confidence(knowing_file: Path, scene_file: Path, tmp_path: Path) -> None:
    scene = GaussianScene.load(knowing_file)
    arguments = ("render", knowing_file, "-o", tmp_path / "f.npz", "--min-confidence", 0.5)
    assert run(*arguments, "--sampler", "around", "--count", 30, "--translation-mm", 8).exit_code == 0
    with np.load(tmp_path / "f.npz") as frames:
        assert frames["confidence"].shape == (30,)
        assert frames["confidence"].min() >= 0.5

    poses = scene.training_poses.copy()
    poses[3, :3, 3] += 50.0 * poses[3, :3, 1]
    np.save(tmp_path / "far.npy", poses)
    assert "poses[3] has a confidence of" in refused(*arguments, "--poses", tmp_path / "far.npy")
    kept = run(*arguments, "--poses", tmp_path / "far.npy", "--sampler", "training")
    assert kept.exit_code == 0, kept.output
    with np.load(tmp_path / "f.npz") as frames:
        np.testing.assert_array_equal(frames["poses"], poses[[0, 1, 2, 4]])
    told = figure_arrays(Assessor(scene.info, scene.training_poses).assess(scene.training_poses))["confidence"]
    some = run("render", knowing_file, "-o", tmp_path / "f.npz", "--min-confidence", np.median(told))
    assert "wrote" in some.output
    with np.load(tmp_path / "f.npz") as frames:
        np.testing.assert_array_equal(frames["poses"], scene.training_poses[told >= np.median(told)])
    assert "needs a scene that knows" in refused("render", scene_file, *arguments[2:])


def test_info_tells_how_well_a_scene_knows_its_confidence(knowing_file: Path, scene_file: Path) -> None:
    document = json.loads(run("info", knowing_file, "--json").output)
    assert (document["confidence"]["error"], document["confidence"]["fitted_on"]) == (0.04, 20)
    assert "hardness" not in document["confidence"]
    assert "error=0.04" in run("info", knowing_file).output
    assert json.loads(run("info", scene_file, "--json").output)["confidence"] == {}


def test_render_samples_poses_into_the_format_of_the_name(scene_file: Path, pose_file: Path, tmp_path: Path) -> None:
    sampler = ("--sampler", "fan", "--tilt-deg", 2, "--step-deg", 2, "--poses", pose_file)
    for name in ("f.npz", "f.igs.mha", "f.h5"):
        result = run("render", scene_file, *sampler, "--dtype", "uint8", "-o", tmp_path / name)
        assert result.exit_code == 0, result.output
        assert "21 frames of 24x20" in result.output
    with np.load(tmp_path / "f.npz") as frames:
        np.testing.assert_array_equal(frames["poses"], FanSampler(2, 2).poses(np.load(pose_file), LINEAR))
        sweep, _ = read_plus_sweep(tmp_path / "f.igs.mha")
        np.testing.assert_array_equal(sweep.images, frames["bmode"])
        np.testing.assert_allclose(sweep.poses, frames["poses"], atol=1e-9)
        with h5py.File(tmp_path / "f.h5") as file:
            np.testing.assert_array_equal(file["bmode"], frames["bmode"])


def test_render_with_another_probe_as_a_fan(scene_file: Path, tmp_path: Path) -> None:
    folder = tmp_path / "fan"
    result = run("render", scene_file, "--probe", CONVEX_JSON, "--scan-convert", 0.5, "-o", folder)
    assert result.exit_code == 0, result.output
    picture = cv2.imread(str(folder / "frame_00000_bmode.png"), cv2.IMREAD_UNCHANGED)
    scene = GaussianScene.load(scene_file)
    frame = render(scene, CONVEX, scene.training_poses[:1], height=24, width=20).bmode
    assert frame is not None
    np.testing.assert_array_equal(picture, np.rint(CONVEX.scan_convert(frame[0].numpy(), 0.5) * 255))


@pytest.fixture
def labelled_file(tmp_path: Path, random_scene: Callable[..., GaussianScene]) -> Path:
    labels = torch.arange(60, dtype=torch.uint8) % 3
    info = SceneInfo(probe=PHASED, image_height=24, image_width=20, label_names={1: "bone", 2: "fat"})
    GaussianScene.from_splats(random_scene(60).splats, info=info, labels=labels, training_poses=np.eye(4)[None]).save(
        tmp_path / "labelled.ugr"
    )
    return tmp_path / "labelled.ugr"


def test_labels_are_written_as_they_are(labelled_file: Path, tmp_path: Path) -> None:
    arguments = ("render", labelled_file, "--outputs", "labels,bmode", "-o")
    for more in ((tmp_path / "f.npz",), (tmp_path / "flat",), (tmp_path / "fan", "--scan-convert", 0.5)):
        result = run(*arguments, *more)
        assert result.exit_code == 0, result.output
    scene = GaussianScene.load(labelled_file)
    truth = render(scene, None, scene.training_poses, height=24, width=20, outputs=("labels",)).labels
    assert truth is not None
    assert {*truth.unique().tolist()} == {0, 1, 2}
    with np.load(tmp_path / "f.npz") as frames:
        assert (frames["labels"].dtype, frames["bmode"].dtype) == (np.uint8, np.float32)
        np.testing.assert_array_equal(frames["labels"], truth)
    flat, fan = (
        cv2.imread(str(tmp_path / name / "frame_00000_labels.png"), cv2.IMREAD_UNCHANGED) for name in ("flat", "fan")
    )
    np.testing.assert_array_equal(flat, truth[0])
    np.testing.assert_array_equal(fan, PHASED.scan_convert_labels(truth[0].numpy(), 0.5))


def test_info_tells_of_labels_and_a_phased_probe(labelled_file: Path) -> None:
    document = json.loads(run("info", labelled_file, "--json").output)
    assert document["label_names"] == {"1": "bone", "2": "fat"}
    assert document["probe"] == {"kind": "phased", "opening_angle_deg": 90.0, "far_mm": 50.0}
    assert "1=bone" in run("info", labelled_file).output


def test_threads_and_backend_are_used(scene_file: Path, tmp_path: Path) -> None:
    result = run("render", scene_file, "-o", tmp_path / "f.npz", "--threads", 3, "--backend", "reference")
    assert result.exit_code == 0
    assert torch.get_num_threads() == 3
    with np.load(tmp_path / "f.npz") as frames:
        assert str(frames["renderer"]).endswith(" reference")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--outputs", "bmode,doppler"], "doppler"),
        (["--outputs", ","], "at least one of bmode"),
        (["--outputs", "bmode,labels"], "labels only for a scene whose Gaussians carry labels"),
        (["--height", 0], "height must be an integer from 1"),
        (["--width", 100_000], "width must be an integer from 1"),
        (["--backend", "gpu"], "backend must be one of"),
        (["--probe", "{"], "--probe must be a JSON object"),
        (["--probe", '{"kind": "linear", "width_mm": 40, "near_mm": 50, "far_mm": 50}'], "far_mm must be greater"),
        (["--probe", '{"kind": "sector"}'], 'kind "linear", "convex" or "phased"'),
        (["--poses", "absent.npy"], "absent.npy: no such file"),
        (["--scan-convert", 0.5], "--scan-convert draws PNGs of a convex or phased probe only"),
        (["--scan-convert", 0.0, "--probe", CONVEX_JSON], "--scan-convert must be between"),
        (["-o", "frames.png"], "ends in .npz, .tar, .zarr.zip, .h5, .dcm, .igs.mha, or a folder"),
        (["-o", "frames.dcm", "--outputs", "echo"], "bmode alone in format dicom"),
        (["-o", "frames.tar", "--dtype", "int8"], "dtype must be one of"),
        (["--dtype", "uint8"], "--dtype must be left out for PNGs"),
        (["--sampler", "orbit"], "kind must be one of training, around"),
        (["--sampler", "around"], "count is required by sampler around"),
        (["--seed", 3], "--seed is of a sampler"),
        (["-o", "absent/frames.npz"], "absent does not"),
    ],
)
def test_mistakes_of_render_are_named(
    scene_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[object], message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    before = sorted(tmp_path.iterdir())
    output = [] if "-o" in arguments else ["-o", "pictures"]
    assert message in refused("render", scene_file, *output, *arguments)
    assert sorted(tmp_path.iterdir()) == before


def test_a_scene_that_knows_no_probe_or_poses_asks_for_them(
    tmp_path: Path, random_scene: Callable[..., GaussianScene]
) -> None:
    path = tmp_path / "bare.ugr"
    random_scene(3).save(path)
    assert "--probe must be given" in refused("render", path, "-o", tmp_path / "f.npz")
    assert "--poses must be given" in refused("render", path, "-o", tmp_path / "f.npz", "--probe", CONVEX_JSON)


def test_a_bad_scene_file_is_named(tmp_path: Path) -> None:
    path = tmp_path / "bad.ugr"
    path.write_bytes(b"nonsense that is long enough")
    for command in (["info", path], ["render", path, "-o", tmp_path / "f.npz"], ["serve", path]):
        assert "bad.ugr: not a scene file" in refused(*command)


def test_info_tells_what_the_file_says(scene_file: Path) -> None:
    result = run("info", scene_file, "--json")
    assert result.exit_code == 0
    document = json.loads(result.output)
    assert document["sha256"] == file_sha256(scene_file)
    assert document["gaussian_count"] == 60
    assert document["probe"] == {"kind": "linear", "width_mm": 30.0, "near_mm": 0.0, "far_mm": 40.0}
    assert document["centre_mm"] == [1.0, 2.0, 3.0]
    assert document["training_poses"]["count"] == 5
    table = run("info", scene_file).output
    for expected in (file_sha256(scene_file), "gaussian_count", "60", "width_mm=30"):
        assert expected in table


@pytest.fixture
def released(tmp_path: Path, random_scene: Callable[..., GaussianScene], random_poses: Callable[..., Any]) -> Path:
    torch.save({"step": 3, "splats": random_scene(8).splats}, tmp_path / "ckpt.pt")
    conf = {
        "images_file_train": "images_train.npy",
        "ultrasound_near_plane": 0.0,
        "ultrasound_far_plane": 4.0,
        "ultrasound_opening_width": 3.0,
    }
    (tmp_path / "conf.json").write_text(json.dumps(conf))
    np.save(tmp_path / "images_train.npy", np.zeros((4, 9, 7), np.uint8))
    np.save(tmp_path / "poses_train.npy", random_poses(4))
    return tmp_path


def test_import_checkpoint_writes_a_scene(released: Path) -> None:
    output = released / "scene.ugr"
    common = ("import-checkpoint", released / "ckpt.pt", "--config", released / "conf.json", "-o", output)
    result = run(*common, "--poses", released / "poses_train.npy")
    assert result.exit_code == 0, result.output
    scene = GaussianScene.load(output)
    assert scene.info.probe == LinearProbe(width_mm=30.0, near_mm=0.0, far_mm=45.0)
    assert len(scene.training_poses) == 4
    assert run(*common, "--center", "-1", "2.5", "-3e2").exit_code == 0
    assert GaussianScene.load(output).info.centre_mm == (-1.0, 2.5, -300.0)
    assert run(*common, "--centered", "--image-height", 5).exit_code == 0
    assert GaussianScene.load(output).info.image_height == 5


def test_import_checkpoint_says_what_it_needs(released: Path) -> None:
    output = released / "scene.ugr"
    common = ("import-checkpoint", released / "ckpt.pt", "--config", released / "conf.json", "-o", output)
    for extra in ([], ["--centered", "--center", 0, 0, 0]):
        message = refused(*common, *extra)
        assert all(option in message for option in ("--poses", "--center X Y Z", "--centered"))
    (released / "images_train.npy").unlink()
    assert "--image-height" in refused(*common, "--centered")
    (released / "ckpt.pt").write_bytes(b"")
    assert "ckpt.pt: truncated" in refused(*common, "--centered", "--image-height", 9)
    assert not output.exists()


def test_demo_writes_the_demo_scene(tmp_path: Path) -> None:
    output = tmp_path / "d.ugr"
    assert run("demo", "-o", output).exit_code == 0
    assert output.read_bytes() == DEMO_FILE.read_bytes()
    assert "folder that exists" in refused("demo", "-o", tmp_path / "absent" / "d.ugr")
    assert "output must end in .ugr, got 'd.txt'" in refused("demo", "-o", tmp_path / "d.txt")


def test_a_data_folder_without_scenes_gets_the_demo(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "data"
    with pytest.raises(InvalidArgument, match="existing folder"):  # its name may be mistyped
        ensure_scenes(folder)
    folder.mkdir()
    ensure_scenes(folder)
    assert [p.name for p in folder.iterdir()] == ["demo.ugr"]
    assert "holds no scenes: wrote" in capsys.readouterr().err
    assert (folder / "demo.ugr").read_bytes() == DEMO_FILE.read_bytes()
    ensure_scenes(folder)
    assert capsys.readouterr().err == ""


def test_a_data_folder_with_scenes_is_left_alone(scene_file: Path) -> None:
    before = sorted(scene_file.parent.iterdir())
    ensure_scenes(scene_file.parent)
    assert sorted(scene_file.parent.iterdir()) == before


def test_given_scenes_are_linked_under_their_own_names(scene_file: Path, tmp_path: Path) -> None:
    folder = tmp_path / "links"
    folder.mkdir()
    link_scenes([scene_file], folder)
    assert (folder / "scene.ugr").resolve() == scene_file.resolve()
    with pytest.raises(InvalidArgument, match="'scene' comes twice"):
        link_scenes([scene_file], folder)
    odd = scene_file.rename(tmp_path / "no name.ugr")
    with pytest.raises(InvalidArgument, match="letters, digits"):
        link_scenes([odd], folder)
    with pytest.raises(SceneFileInvalid, match="no such file"):
        link_scenes([tmp_path / "absent.ugr"], folder)


def test_mistakes_of_serve_are_named(scene_file: Path, tmp_path: Path) -> None:
    assert "cannot be given together" in refused("serve", scene_file, "--data-folder", tmp_path)
    assert "http_port" in refused("serve", scene_file, "--http-port", 70_000)
    assert "backend" in refused("serve", scene_file, "--backend", "gpu")


def test_serve_serves_the_given_file_until_sigterm(scene_file: Path, tmp_path: Path) -> None:
    arguments = ("serve", scene_file, "--http-port", 0, "--grpc-port", 0, "--threads", 1)
    program = "from ultragray_service.cli import app; app()"
    with subprocess.Popen(
        python(program, *arguments), stderr=subprocess.STDOUT, stdout=subprocess.PIPE, text=True
    ) as service:
        try:
            assert service.stdout is not None
            address = next(m[0] for line in service.stdout if (m := re.search(r"http://127\.0\.0\.1:\d+", line)))
            with urllib.request.urlopen(f"{address}/v1/scenes", timeout=10) as answer:
                assert [scene["name"] for scene in json.load(answer)["scenes"]] == ["scene"]
            service.send_signal(signal.SIGTERM)
            started = time.monotonic()
            service.stdout.read()
            assert service.wait(timeout=20) == 0
            assert time.monotonic() - started < 15
        finally:
            service.kill()
    assert scene_file.exists()
