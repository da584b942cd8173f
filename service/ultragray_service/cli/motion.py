"""`ultragray motion`: a new scene file of one whose tissue moves. `ultragray jobs submit motion`: on a service."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import numpy as np

from ultragray.errors import InvalidArgument
from ultragray.geometry.registration import load_registration
from ultragray.scene.info import read_header
from ultragray.scene.label_maps import VECTOR_FIELD_SUFFIXES, read_vector_field
from ultragray.scene.motion_settings import AUTO, FIELD, MotionSettings
from ultragray_service.cli.options import with_options
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

_SWEEP = "Learned from frames"


@single(
    "ultragray motion liver.ugr -o breathing.ugr --sweep sweep.mha --surrogate belt.csv",
    "ultragray motion liver.ugr -o breathing.ugr --field inhale.nii.gz --field-leads from-rest --field-axes lps",
    "ultragray motion liver.ugr -o breathing.ugr --chest-mm 8",
    """ultragray motion breathing.ugr -o both.ugr --pulse-mm 0.5 --vessel '{"kind": "label", "name": "artery"}'""",
)
@with_options
def motion(
    scene: SceneFile,
    output: Annotated[Path, output_option("Scene file to write (.ugr or .ugz).")],
    sweep: Annotated[str | None, option("The sweep that the scene was trained from.", panel=_SWEEP)] = None,
    surrogate: Annotated[
        str | None,
        option(f"A file with a number a line for each frame, such as a belt's; {AUTO}: found.", panel=_SWEEP),
    ] = None,
    field: Annotated[
        Path | None,
        option(f"A vector in mm for each voxel ({', '.join(VECTOR_FIELD_SUFFIXES)}), of a number of 1.", panel=FIELD),
    ] = None,
    registration: Annotated[
        Path | None,
        option("File of `ultragray calibrate` (.json) that leads the field into the scene.", panel=FIELD),
    ] = None,
    force: Force = False,
    json: Json = False,
    *,
    settings: MotionSettings,
) -> None:
    """One mode more: learned from a sweep, of a field, or built in. `phase` has a number for each, in their order."""
    check_file(output, [SCENE_SUFFIX, COMPRESSED_SUFFIX], force=force)
    read_header(scene)
    settings.check_source(sweep=sweep is not None, field=field is not None)
    if (sweep is None) != (surrogate is None):
        raise InvalidArgument("--sweep and --surrogate belong together", field="surrogate")
    settings.check_field(is_given=field is not None)
    link = None if registration is None else load_registration(registration)
    voxels = None if field is None else read_vector_field(field, settings.field_axes)

    from ultragray import GaussianScene
    from ultragray.datasets.source import load_dataset
    from ultragray.learn.motion import add_motion, numbers_of, read_numbers
    from ultragray.learn.motion_fields import field_of_voxels

    numbers = None if surrogate in (None, AUTO) else read_numbers(surrogate)
    loaded = GaussianScene.load(scene)
    sources: dict[str, Any] = {}
    if sweep is not None and surrogate is not None:
        train = sources["sweep"] = load_dataset(sweep).train
        if numbers is not None:
            sources |= {"numbers": numbers_of(train, numbers, surrogate), "surrogate": Path(surrogate).name}
    if voxels is not None and settings.field_leads is not None:
        to_scene = None if link is None else np.asarray(link.base_to_scene)
        sources["field"] = field_of_voxels(voxels, loaded.info, settings.field_leads, to_scene)
    with counted("learning motion", settings.steps if sweep else 1) as count_done:
        added = add_motion(loaded, settings, **sources, report=lambda done, _: count_done(done))
    added.scene.save(output)
    facts = added.facts()
    mode, residual = facts["modes"][-1], facts["residual_mm"]
    words = f"wrote {output}: {mode['name']} between {mode['low']:g} and {mode['high']:g}, at rest at {mode['rest']:g}"
    if residual is not None:
        words += f"; {residual['rms']:.2g} mm (rms) from the field, at most {residual['most']:.2g} mm"
    if (tube := added.tube) is not None:
        words += f"; the vessel's radius is {tube.radius_mm:.1f} mm"
    tell(words, {"output": str(output), **facts}, as_json=json)
