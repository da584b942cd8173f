"""`ultragray calibrate`: points, poses or frames in, a registration out."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np

from ultragray import render
from ultragray.geometry.probe import FloatArray
from ultragray.geometry.registration import load_registration
from ultragray.phantom.demo import DEMO_FILE, demo_poses, load_demo_scene

from .command_line import refused, run


def motion(rng: np.random.Generator) -> FloatArray:
    pose = np.eye(4)
    pose[:3, :3] = cv2.Rodrigues(rng.normal(size=3))[0]
    pose[:3, 3] = 100.0 * rng.normal(size=3)
    return pose


def test_points_are_registered_and_residuals_told(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    true, points = motion(rng), 50.0 * rng.normal(size=(5, 3))
    np.savetxt(tmp_path / "base.csv", points, delimiter=",")
    np.save(tmp_path / "scene.npy", points @ true[:3, :3].T + true[:3, 3])
    output = tmp_path / "robot.json"
    result = run("calibrate", "points", tmp_path / "base.csv", tmp_path / "scene.npy", "-o", output)
    assert result.exit_code == 0, result.output
    assert "from 5 points" in result.stdout
    assert "residuals: " in result.stdout
    np.testing.assert_allclose(load_registration(output).base_to_scene, true, atol=1e-9)
    assert "exists: --force" in refused(
        "calibrate", "points", tmp_path / "base.csv", tmp_path / "scene.npy", "-o", output
    )


def test_poses_give_the_mounting_as_well(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    base_to_scene, mounting = motion(rng), motion(rng)
    flanges = np.stack([motion(rng) for _ in range(5)])
    np.save(tmp_path / "flange.npy", flanges)
    np.save(tmp_path / "probe.npy", base_to_scene @ flanges @ mounting)
    np.save(tmp_path / "mounting.npy", mounting)
    asked = ("calibrate", "poses", tmp_path / "flange.npy", tmp_path / "probe.npy", "-o", tmp_path / "robot.json")
    document = json.loads(run(*asked, "--find-mounting", "--json").stdout)
    np.testing.assert_allclose(document["probe_to_flange"], mounting, atol=1e-6)
    given = json.loads(run(*asked, "--probe-to-flange", tmp_path / "mounting.npy", "--json", "--force").stdout)
    np.testing.assert_allclose(given["base_to_scene"], base_to_scene, atol=1e-6)
    both = ("--find-mounting", "--probe-to-flange", tmp_path / "mounting.npy", "--force")
    assert "name one of them" in refused(*asked, *both)


def test_samples_that_contradict_each_other_end_with_a_status_that_a_script_sees(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    base_to_scene, mounting = motion(rng), motion(rng)
    flanges = np.stack([motion(rng) for _ in range(8)])
    np.save(tmp_path / "flange.npy", flanges)
    np.save(tmp_path / "probe.npy", (base_to_scene @ flanges @ mounting)[[0, 3, 2, 1, 4, 5, 6, 7]])
    asked = ("calibrate", "poses", tmp_path / "flange.npy", tmp_path / "probe.npy", "-o", tmp_path / "robot.json")
    result = run(*asked, "--find-mounting", "--json")
    assert result.exit_code == 1
    (told,) = json.loads(result.stdout)["warnings"]
    assert told.startswith("the samples contradict each other: sample ")
    assert "samples 1 and 3 are exchanged" in told
    assert told in result.stderr
    points = 50.0 * rng.normal(size=(6, 3))
    np.save(tmp_path / "base.npy", points)
    np.save(tmp_path / "scene.npy", (points @ base_to_scene[:3, :3].T)[[0, 1, 2, 4, 3, 5]])
    result = run("calibrate", "points", tmp_path / "base.npy", tmp_path / "scene.npy", "-o", tmp_path / "points.json")
    assert result.exit_code == 1
    assert "samples 3 and 4 are exchanged" in result.stderr


def test_frames_register_a_robot(tmp_path: Path) -> None:
    base_to_scene, poses = motion(np.random.default_rng(2)), demo_poses(5)[1:4]
    frames = render(load_demo_scene(), None, poses, height=96, width=96, outputs=("bmode",))["bmode"]
    np.save(tmp_path / "frames.npy", frames.detach().numpy())
    np.save(tmp_path / "flange.npy", np.linalg.inv(base_to_scene) @ poses)
    about = base_to_scene.copy()
    about[:3, 3] += (1.0, -1.0, 0.5)
    np.save(tmp_path / "about.npy", about)
    asked = ("calibrate", "frames", DEMO_FILE, tmp_path / "flange.npy", tmp_path / "frames.npy")
    result = run(*asked, "--start", tmp_path / "about.npy", "-o", tmp_path / "robot.json", "--json")
    assert result.exit_code == 0, result.output
    document = json.loads(result.stdout)
    assert document["left_out"] == []
    found = np.array(document["base_to_scene"]) @ np.linalg.inv(base_to_scene) @ poses
    np.testing.assert_allclose(found, poses, atol=0.3)


def test_mistakes_are_told_in_one_line(tmp_path: Path) -> None:
    np.save(tmp_path / "line.npy", np.outer(np.arange(4.0), np.ones(3)))
    (tmp_path / "points.txt").touch()
    output = ("-o", tmp_path / "robot.json")
    line = refused("calibrate", "points", tmp_path / "line.npy", tmp_path / "line.npy", *output)
    assert "points lie on a line" in line
    assert "must end in .npy or .csv" in refused(
        "calibrate", "points", tmp_path / "points.txt", tmp_path / "line.npy", *output
    )
    assert not (tmp_path / "robot.json").exists()
