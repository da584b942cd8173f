"""`ultragray motion`: a new scene file of one whose tissue moves."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from ultragray.errors import InvalidArgument
from ultragray.scene.info import read_header
from ultragray.scene.modes import FIT_STEPS
from ultragray_service.cli.terminal import (
    COMPRESSED_SUFFIX,
    SCENE_SUFFIX,
    Force,
    Json,
    SceneFile,
    check_file,
    counted,
    option,
    output_option,
    single,
    tell,
)


@single(
    "ultragray motion liver.ugr -o breathing.ugr --sweep sweep.mha --surrogate belt.csv",
    "ultragray motion liver.ugr -o breathing.ugr --chest-mm 8",
)
def motion(
    scene: SceneFile,
    output: Annotated[Path, output_option("Scene file to write (.ugr or .ugz).")],
    sweep: Annotated[str | None, option("The sweep that the scene was trained from.")] = None,
    surrogate: Annotated[Path | None, option("A number a line for each frame of the sweep, such as a belt's.")] = None,
    chest_mm: Annotated[float | None, option("Built in: deep tissue goes so far from the skin and back.")] = None,
    name: Annotated[str, option("Of the mode.")] = "breathing",
    steps: Annotated[int, option("Of the fit.", min=1, max=100_000)] = FIT_STEPS,
    force: Force = False,
    json: Json = False,
) -> None:
    """One mode of motion: learned from a sweep whose frames have a number each, or a chest that breathes."""
    check_file(output, [SCENE_SUFFIX, COMPRESSED_SUFFIX], force=force)
    read_header(scene)
    if (sweep is None) != (surrogate is None) or (sweep is None) == (chest_mm is None):
        raise InvalidArgument("either --sweep and --surrogate must be given, or --chest-mm", field="sweep")

    from ultragray import GaussianScene
    from ultragray.datasets.source import load_dataset
    from ultragray.learn.motion import chest_motion, fit_motion, read_numbers, with_motion

    loaded = GaussianScene.load(scene)
    if sweep is not None and surrogate is not None:
        train = load_dataset(sweep).train
        numbers = read_numbers(surrogate, int(train.frame_numbers.max()) + 1)[train.frame_numbers]
        with counted("learning motion", steps) as count:
            moving = fit_motion(
                loaded,
                train,
                numbers,
                name=name,
                surrogate=surrogate.name,
                steps=steps,
                report=lambda done, _: count(done),
            )
    else:
        assert chest_mm is not None
        moving = with_motion(loaded, *chest_motion(loaded.info, chest_mm))
    moving.save(output)
    assert moving.info.motion is not None
    (mode,) = moving.info.motion.modes
    tell(
        f"wrote {output}: {mode.name} between {mode.low:g} and {mode.high:g}, at rest at {mode.rest:g}",
        {"output": str(output), "mode": mode.name, "low": mode.low, "high": mode.high, "rest": mode.rest},
        as_json=json,
    )
