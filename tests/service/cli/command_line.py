"""The command line in this process, or as a fresh one."""

import logging
import sys

import numpy as np
from typer.testing import CliRunner

from ultragray import LinearProbe
from ultragray.datasets import Dataset, Sweep
from ultragray.datasets.released import write_released
from ultragray_service.cli.app import app


def run(*arguments):
    root = logging.getLogger()
    handlers, level = root.handlers[:], root.level
    try:
        return CliRunner().invoke(app, [str(argument) for argument in arguments])
    finally:  # serve logs to the stream of this call, which is closed when a later test logs
        root.handlers[:] = handlers
        root.setLevel(level)


def succeeded(*arguments):
    result = run(*arguments)
    assert result.exit_code == 0, result.output
    return result


def refused(*arguments):
    """The one line that a mistake gives."""
    result = run(*arguments)
    assert result.exit_code == 2, result.output
    assert "Traceback" not in result.output
    assert result.stderr.startswith("error: ")
    assert result.stderr.count("\n") == 1
    return result.stderr


def noise_sweep(folder, frames=10):
    """A sweep of noise in the released layout, 20x16 pixels, a millimetre between frames; the last two are held out."""
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, 1, 3] = np.arange(frames)
    images = np.random.default_rng(0).integers(0, 250, (frames, 20, 16), dtype=np.uint8)
    sweep = Sweep(images, poses, LinearProbe(40.0, 0.0, 50.0), np.arange(frames), "sweep")
    write_released(
        Dataset(folder.name, sweep.select(range(frames - 2)), sweep.select([frames - 2, frames - 1])), folder
    )
    return folder


def python(program, *arguments):
    """A command for a fresh process that finds the packages as this one does."""
    return [sys.executable, "-c", f"import sys; sys.path[:0] = {sys.path!r}; {program}", *map(str, arguments)]
