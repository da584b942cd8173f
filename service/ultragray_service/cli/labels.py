"""`ultragray label`: labels for the Gaussians of a scene file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np

from ultragray.errors import InvalidArgument
from ultragray.geometry.registration import load_registration
from ultragray.scene.info import DEFAULT_WITHIN_MM, read_header
from ultragray.scene.label_maps import (
    LABEL_MAP_SUFFIXES,
    PAINTED_SUFFIX,
    parse_names,
    read_label_map,
    read_painted,
)
from ultragray_service.cli.terminal import (
    SCENE_SUFFIX,
    Force,
    Json,
    SceneFile,
    check_file,
    option,
    output_option,
    single,
    tell,
    working,
)

MapOption = Annotated[
    Path | None,
    option(f"A label map ({', '.join(LABEL_MAP_SUFFIXES)}) in mm, RAS+; needs the extra nifti.", "--map", shown=False),
]
FramesOption = Annotated[
    Path | None,
    option(
        f"Painted frames ({PAINTED_SUFFIX}): poses [C, 4, 4] and labels [C, H, W], 0 no label, 255 not painted.",
        shown=False,
    ),
]
NamesOption = Annotated[str, option("Names of labels, such as 1=bone,2=muscle.", shown="those of the scene")]
WithinOption = Annotated[
    float, option("Gaussians that nothing labels take the label of labelled ones that lie within, and echo alike.")
]


def check_source(label_map: Path | None, frames: Path | None) -> None:
    """Raises InvalidArgument unless exactly one is given."""
    if (label_map is None) == (frames is None):
        raise InvalidArgument("give exactly one of --map, a label map, and --frames, painted frames", field="map")


@single(
    "ultragray label liver.ugr -o labelled.ugr --map segmentation.nii.gz --names 1=vessel,2=tumour",
    "ultragray label liver.ugr -o labelled.ugr --map ct.nii.gz --registration ct_to_scene.json",
    "ultragray label liver.ugr -o labelled.ugr --frames painted.npz --names 1=vessel",
)
def label(
    scene: SceneFile,
    output: Annotated[Path, output_option("Scene file to write (.ugr).")],
    label_map: MapOption = None,
    frames: FramesOption = None,
    names: NamesOption = "",
    within_mm: WithinOption = DEFAULT_WITHIN_MM,
    registration: Annotated[
        Path | None,
        option("File of `ultragray calibrate` (.json) that leads the map, or poses, into the scene.", shown=False),
    ] = None,
    force: Force = False,
    json: Json = False,
) -> None:
    """The scene's own labels stay where the map or the frames say nothing."""
    check_source(label_map, frames)
    check_file(output, [SCENE_SUFFIX], force=force)
    read_header(scene)
    known = parse_names(names)
    link = None if registration is None else load_registration(registration)
    painted = None if frames is None else read_painted(frames)
    volume = None if label_map is None else read_label_map(label_map)

    from ultragray import GaussianScene
    from ultragray.learn.labelling import PaintedFrame, label_by_frames, label_by_map

    with working("labelling …"):
        loaded = GaussianScene.load(scene)
        if volume is not None:
            to_scene = None if link is None else link.base_to_scene
            new_scene = label_by_map(loaded, *volume, names=known, map_to_scene=to_scene, within_mm=within_mm)
        elif painted is not None:
            poses = painted.poses if link is None else link.probe_to_scene(painted.poses)
            pairs = [PaintedFrame(pose, labels) for pose, labels in zip(poses, painted.labels, strict=True)]
            new_scene = label_by_frames(loaded, pairs, names=known, within_mm=within_mm)
    new_scene.save(output)
    of_each = np.bincount(np.zeros(0, int) if new_scene.labels is None else new_scene.labels.numpy(), minlength=256)
    counts = {name: int(of_each[number]) for number, name in new_scene.info.label_names.items()}
    document = {"output": str(output), "gaussian_count": new_scene.gaussian_count, "labelled": counts}
    words = ", ".join(f"{count:,} {name}" for name, count in counts.items())
    tell(f"wrote {output}: of {new_scene.gaussian_count:,} Gaussians {words}", document, as_json=json)
