"""Frames of many poses in one file, shown as asked, with an account of how."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

from ultragray import ConvexProbe, GaussianScene, render
from ultragray.confidence import SUPPORT_COVERAGE, Extrapolation
from ultragray.contract import to_dict
from ultragray.display import Display
from ultragray.interchange import rendering
from ultragray.interchange.exports import ExportHeader, export_to
from ultragray.interchange.rendering import render_into

PROBE = ConvexProbe(opening_angle_deg=60.0, near_mm=10.0, far_mm=50.0)
POSES = np.tile(np.eye(4), (5, 1, 1))
POSES[:, 1, 3] = np.arange(5)
UNKNOWN = [Extrapolation(None, None, None, None)] * 5


def header(display: Display, outputs: tuple[str, ...] = ("bmode", "coverage")) -> ExportHeader:
    return ExportHeader(outputs, "float32", POSES, 24, 20, PROBE, "one", "0" * 64, "ultragray/0 cpu", display)


@pytest.mark.parametrize("display", [Display(), Display(depth_mm=20.0, flip=True), Display(pixel_mm=1.0)])
def test_a_file_tells_how_its_frames_are_shown(
    tmp_path: Path, random_scene: Callable[..., GaussianScene], monkeypatch: pytest.MonkeyPatch, display: Display
) -> None:
    monkeypatch.setattr(rendering, "frames_at_once", lambda height, width: 2)
    scene, asked, done = random_scene(60), header(display), []
    sink = export_to(tmp_path / "frames.npz", "npz", asked)
    found = render_into(sink, asked, scene, UNKNOWN, before_portion=done.append)
    assert done == [0, 2, 4, 5]
    coverage = render(scene, PROBE, POSES, height=24, width=20, outputs=("coverage",)).coverage
    assert coverage is not None
    shares = [one.supported_share for one in found]
    np.testing.assert_allclose(shares, (coverage.numpy() >= SUPPORT_COVERAGE).mean(axis=(1, 2)))
    with np.load(tmp_path / "frames.npz") as archive:
        picture = display.picture(PROBE, 24, 20)
        assert archive["bmode"].shape == (5, picture.height, picture.width)
        assert json.loads(str(archive["probe"])) == to_dict(PROBE)
        assert json.loads(str(archive["display"])) == json.loads(json.dumps(asdict(display)))
        assert json.loads(str(archive["picture"])) == json.loads(json.dumps(asdict(picture)))


def test_pixels_without_support_are_black_where_they_are_masked(
    tmp_path: Path, random_scene: Callable[..., GaussianScene]
) -> None:
    scene, asked, masked = random_scene(60), header(Display(gain_db=20.0)), [True, False, True, False, False]
    render_into(export_to(tmp_path / "frames.npz", "npz", asked), asked, scene, UNKNOWN, masked=masked)
    with np.load(tmp_path / "frames.npz") as archive:
        for pixels, coverage, is_masked in zip(archive["bmode"], archive["coverage"], masked, strict=True):
            unsupported = coverage < SUPPORT_COVERAGE
            assert unsupported.any()
            assert (pixels[unsupported] == 0.0).all() == is_masked


def test_what_is_stopped_leaves_nothing(tmp_path: Path, random_scene: Callable[..., GaussianScene]) -> None:
    def stop(done: int) -> None:
        raise KeyboardInterrupt

    asked = header(Display())
    with pytest.raises(KeyboardInterrupt):
        render_into(
            export_to(tmp_path / "frames.npz", "npz", asked), asked, random_scene(3), UNKNOWN, before_portion=stop
        )
    assert list(tmp_path.iterdir()) == []
