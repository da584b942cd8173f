"""`ultragray edit`: a new scene file of one that is moved, cut, merged, relabelled, thinned, or had something put in.
`ultragray from-labels`: one of bodies of tissue, which nobody recorded.

`ultragray scenes edit` and `ultragray scenes from-labels` have the service do the same, and take the same options.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from ultragray.contract import Contract, described
from ultragray.errors import InvalidArgument
from ultragray.exchange.poses import load_poses
from ultragray.rendering.volumes import parse_box, parse_numbers
from ultragray.scene.edits import (
    CutEdit,
    Edit,
    InsertEdit,
    LesionsEdit,
    MergeEdit,
    ThinEdit,
    check_edits,
    read_edits,
    scenes_named,
)
from ultragray.scene.info import read_header
from ultragray.scene.label_maps import LABEL_MAP_SUFFIXES
from ultragray.scene.recipes import SceneRecipe, read_recipe
from ultragray.scene.shapes import BoxShape, SphereShape
from ultragray.scene.tissues import TISSUES
from ultragray_service.cli.options import FieldsOf, poses_option, with_options
from ultragray_service.cli.terminal import (
    COMPRESSED_SUFFIX,
    SCENE_SUFFIX,
    Force,
    Json,
    SceneFile,
    argument,
    check_file,
    option,
    output_option,
    single,
    tell,
    working,
)


@dataclass(frozen=True, kw_only=True)
class EditOptions(Contract):
    """Edits as options give them: those of a document, then the short forms."""

    __topic__ = "Edits, in this order"

    edits: Path | None = described("A list of edits: JSON, or TOML with tables that are called edits.", None)
    cut_box_mm: str | None = described("Keep a box: ranges of x, y and z, such as -20:20,-30:30,0:45.", None)
    merge: str | None = described("Add another scene, in the same frame.", None)
    insert: str | None = described(f"Put in a ball of one of: {', '.join(TISSUES)}.", None)
    at_mm: str | None = described("Its middle x,y,z.", None)
    radius_mm: float = described("Its radius.", 5.0)
    lesions: int | None = described("Put in so many at random places, each labelled.", None)
    seed: int = described("Of the random choices.", 0)
    gaussians: int | None = described("Keep so many Gaussians, those that show most.", None)

    def listed(self) -> tuple[Edit, ...]:
        """Raises InvalidArgument."""
        edits: list[Edit] = [] if self.edits is None else list(read_edits(self.edits))
        if self.cut_box_mm is not None:
            low, high = (_triple(corner) for corner in parse_box(self.cut_box_mm))
            edits.append(CutEdit(shape=BoxShape(min_mm=low, max_mm=high)))
        if self.merge is not None:
            edits.append(MergeEdit(scene=self.merge))
        if (self.insert is None) != (self.at_mm is None):
            raise InvalidArgument("--insert and --at-mm belong together", field="insert")
        if self.insert is not None and self.at_mm is not None:
            ball = SphereShape(centre_mm=_triple(parse_numbers(self.at_mm, 3, "at_mm")), radius_mm=self.radius_mm)
            edits.append(InsertEdit(shape=ball, tissue=self.insert, seed=self.seed))
        if self.lesions is not None:
            edits.append(LesionsEdit(count=self.lesions, seed=self.seed))
        if self.gaussians is not None:
            edits.append(ThinEdit(gaussian_count=self.gaussians))
        if not edits:
            known = "--edits, --cut-box-mm, --merge, --insert with --at-mm, --lesions, --gaussians"
            raise InvalidArgument(f"at least one edit must be given: {known}", field="edits")
        return check_edits(edits)


def _triple(values: Any) -> tuple[float, float, float]:
    x, y, z = map(float, values)
    return x, y, z


@single(
    "ultragray edit liver.ugr -o with-cyst.ugr --insert cyst --at-mm 0,0,30 --radius-mm 6",
    "ultragray edit liver.ugr -o lesions-7.ugr --lesions 3 --seed 7",
    "ultragray edit left.ugr -o whole.ugr --merge right.ugr",
    "ultragray edit liver.ugr -o edited.ugr --edits edits.json",
)
@with_options
def edit(
    scene: SceneFile,
    output: Annotated[Path, output_option("Scene file to write (.ugr or .ugz).")],
    force: Force = False,
    json: Json = False,
    *,
    edits: EditOptions,
) -> None:
    """The scene stays as it is: the new one names it as its parent. Scenes that are merged are files."""
    check_file(output, [SCENE_SUFFIX, COMPRESSED_SUFFIX], force=force)
    read_header(scene)
    edit_list = edits.listed()
    for name in scenes_named(edit_list):
        read_header(name)

    from ultragray import GaussianScene
    from ultragray.files import file_sha256
    from ultragray.learn.editing.editor import edit_scene

    with working("editing …"):
        others = {name: GaussianScene.load(name) for name in scenes_named(edit_list)}
        parents = {path.stem: file_sha256(path) for path in (scene, *map(Path, others))}
        edited = edit_scene(GaussianScene.load(scene), edit_list, others=others, names=parents)
    edited.save(output)
    document = {
        "output": str(output),
        "gaussian_count": edited.gaussian_count,
        "made_labels": [edited.info.label_names[label] for label in edited.info.made_labels],
        "provenance": edited.info.provenance,
    }
    words = f"wrote {output}: {edited.gaussian_count:,} Gaussians, of {', '.join(parents)}"
    tell(words + left_out(edited.info.provenance["edits"]), document, as_json=json)


def left_out(edits: Iterable[Mapping[str, Any]]) -> str:
    """The end of a sentence about a scene that these edits made, as its file tells them: what they did not keep."""
    names = dict.fromkeys(name for edit in edits for name in edit.get("left_out", ()))
    return f"; left out: {', '.join(names)}" if names else ""


_MAPS = ", ".join(LABEL_MAP_SUFFIXES)
LabelsArgument = Annotated[
    Path | None, argument(f"A label map ({_MAPS}) in mm; none where bodies are shapes.", metavar="[LABELS]")
]
TissueOption = Annotated[
    Path | None,
    option(
        r"What its labels stand for, or shapes: TOML with tables [\[bodies]], and any field of a recipe.",
        "--tissue",
        shown=False,
    ),
]
CtOption = Annotated[
    Path | None, option(f"A CT ({_MAPS}), which tells the tissue of what no body covers.", "--ct", shown=False)
]
RECIPE_FIELDS = FieldsOf(
    SceneRecipe,
    *("probe", "frequency_mhz", "dynamic_range_db", "towards", "along", "middle_mm", "sweep_mm", "pose_count"),
    *("image_size", "level", "compensated", "gaussian_count", "seed"),
)


@single(
    "ultragray from-labels ct_labels.nii.gz -o liver.ugr --tissue liver.toml",
    "ultragray from-labels -o phantom.ugr --tissue meshes.toml",
    "ultragray from-labels labels.nrrd -o liver.ugr --tissue liver.toml --ct ct.nii.gz --sweep-mm 120",
)
@with_options
def from_labels(
    output: Annotated[Path, output_option("Scene file to write (.ugr or .ugz).")],
    labels: LabelsArgument = None,
    tissue: TissueOption = None,
    ct: CtOption = None,
    poses: Annotated[Path | None, poses_option(default="a sweep as towards and along say")] = None,
    force: Force = False,
    json: Json = False,
    *,
    recipe: Annotated[dict[str, Any], RECIPE_FIELDS],
) -> None:
    """All of it counts as not recorded, until a training refines it: ultragray train --start-scene."""
    check_file(output, [SCENE_SUFFIX, COMPRESSED_SUFFIX], force=force)
    checked_recipe = read_recipe(tissue, labels, ct, **recipe)
    path = None if poses is None else load_poses(poses)

    from ultragray.learn.synthesis.scene import scene_from_labels

    with working("making the scene …"):
        scene = scene_from_labels(checked_recipe, poses=path)
    scene.save(output)
    names = [*scene.info.label_names.values()]
    document = {"output": str(output), "gaussian_count": scene.gaussian_count, "made_labels": names}
    tell(f"wrote {output}: {scene.gaussian_count:,} Gaussians, {', '.join(names)}", document, as_json=json)
