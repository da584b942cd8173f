"""`ultragray plan`: views are told, written and refused in words."""

import json

import numpy as np

from ultragray import PlanSettings, plan_views
from ultragray.phantom.demo import DEMO_FILE, demo_poses, load_demo_scene

from .command_line import refused, run, succeeded

ASKED = ("--views", "3", "--within-mm", "0.5")


def test_the_plan_of_the_library_is_told_and_written(tmp_path):
    written = tmp_path / "next.npy"
    result = succeeded("plan", DEMO_FILE, *ASKED, "-o", written, "--json")
    plan = plan_views(load_demo_scene(), PlanSettings(views=3, within_mm=0.5))
    document = json.loads(result.stdout)
    np.testing.assert_allclose(document["gains"], plan.gains)
    np.testing.assert_array_equal(np.load(written), plan.poses)
    told = run("plan", DEMO_FILE, *ASKED).stdout
    assert told.startswith(f"3 views, {plan.path_mm:.0f} mm: coverage {plan.before:.3f} → {plan.after:.3f}")


def test_a_plan_that_gains_nothing_ends_with_status_1(tmp_path):
    np.save(tmp_path / "far.npy", demo_poses(3) + np.pad([[0.0], [0.0], [500.0]], ((0, 1), (3, 0))))
    result = run("plan", DEMO_FILE, "--poses", tmp_path / "far.npy", "--region-mm=-10:10,-10:10,0:20")
    assert result.exit_code == 1, result.output
    assert result.stdout.startswith("no pose in reach adds to the coverage of ")


def test_mistakes_are_told_in_one_line(tmp_path):
    np.save(tmp_path / "many.npy", demo_poses(3))
    assert "start must be one pose, got 3" in refused("plan", DEMO_FILE, "--start", tmp_path / "many.npy")
    assert "region_mm must be ranges" in refused("plan", DEMO_FILE, "--region-mm", "1:2")
    assert "want must be one of coverage, confidence, uncertainty" in refused("plan", DEMO_FILE, "--want", "fame")
