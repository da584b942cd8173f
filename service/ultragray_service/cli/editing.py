"""`ultragray edit`: a new scene file of one that is moved, cut, merged, relabelled, thinned, or had something put in.

`ultragray scenes edit` has the service do the same, and takes the same options.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from ultragray.errors import InvalidArgument
from ultragray.rendering.volumes import parse_box, parse_numbers
from ultragray.scene.edits import (
    TISSUES,
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
from ultragray.scene.shapes import BoxShape, SphereShape
from ultragray_service.cli.terminal import (
    COMPRESSED_SUFFIX,
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

_SHORT = "Short forms, in this order"

EditsOption = Annotated[
    Path | None,
    option("A list of edits: JSON, or TOML with tables [[edits]]; the short forms come after it.", shown=False),
]
CutOption = Annotated[
    str | None,
    option("Keep a box: ranges of x, y and z, such as -20:20,-30:30,0:45.", "--cut-box-mm", shown=False, panel=_SHORT),
]
MergeOption = Annotated[
    str | None, option("Add another scene, in the same frame.", "--merge", shown=False, panel=_SHORT)
]
InsertOption = Annotated[
    str | None, option(f"Put in a ball of one of: {', '.join(TISSUES)}.", "--insert", shown=False, panel=_SHORT)
]
AtOption = Annotated[str | None, option("Its middle x,y,z.", shown=False, panel=_SHORT)]
RadiusOption = Annotated[float, option("Its radius.", panel=_SHORT)]
LesionsOption = Annotated[
    int | None, option("Put in so many at random places, each labelled.", "--lesions", shown=False, panel=_SHORT)
]
SeedOption = Annotated[int, option("Of the random choices.", panel=_SHORT)]
ThinOption = Annotated[
    int | None,
    option("Keep so many Gaussians, those that show most.", "--gaussians", shown=False, panel=_SHORT),
]


def edits_asked(
    document: Path | None,
    cut_box_mm: str | None,
    merge: str | None,
    insert: str | None,
    at_mm: str | None,
    radius_mm: float,
    lesions: int | None,
    seed: int,
    gaussians: int | None,
) -> tuple[Edit, ...]:
    """The edits of a document, then those of the short forms. Raises InvalidArgument."""
    found: list[Edit] = [] if document is None else list(read_edits(document))
    if cut_box_mm is not None:
        low, high = (_triple(corner) for corner in parse_box(cut_box_mm))
        found.append(CutEdit(shape=BoxShape(min_mm=low, max_mm=high)))
    if merge is not None:
        found.append(MergeEdit(scene=merge))
    if (insert is None) != (at_mm is None):
        raise InvalidArgument("--insert and --at-mm belong together", field="insert")
    if insert is not None and at_mm is not None:
        middle = _triple(parse_numbers(at_mm, 3, "at_mm"))
        found.append(InsertEdit(shape=SphereShape(centre_mm=middle, radius_mm=radius_mm), tissue=insert, seed=seed))
    if lesions is not None:
        found.append(LesionsEdit(count=lesions, seed=seed))
    if gaussians is not None:
        found.append(ThinEdit(gaussian_count=gaussians))
    return check_edits(found)


def _triple(values: Any) -> tuple[float, float, float]:
    x, y, z = map(float, values)
    return x, y, z


@single(
    "ultragray edit liver.ugr -o with-cyst.ugr --insert cyst --at-mm 0,0,30 --radius-mm 6",
    "ultragray edit liver.ugr -o lesions-7.ugr --lesions 3 --seed 7",
    "ultragray edit left.ugr -o whole.ugr --merge right.ugr",
    "ultragray edit liver.ugr -o edited.ugr --edits edits.json",
)
def edit(
    scene: SceneFile,
    output: Annotated[Path, output_option("Scene file to write (.ugr or .ugz).")],
    edits: EditsOption = None,
    cut_box_mm: CutOption = None,
    merge: MergeOption = None,
    insert: InsertOption = None,
    at_mm: AtOption = None,
    radius_mm: RadiusOption = 5.0,
    lesions: LesionsOption = None,
    seed: SeedOption = 0,
    gaussians: ThinOption = None,
    force: Force = False,
    json: Json = False,
) -> None:
    """The scene stays as it is: the new one names it as its parent. Scenes that are merged are files."""
    check_file(output, [SCENE_SUFFIX, COMPRESSED_SUFFIX], force=force)
    read_header(scene)
    asked = edits_asked(edits, cut_box_mm, merge, insert, at_mm, radius_mm, lesions, seed, gaussians)
    for name in scenes_named(asked):
        read_header(name)

    from ultragray import GaussianScene
    from ultragray.files import file_sha256
    from ultragray.learn.editing.editor import edit_scene

    with working("editing …"):
        others = {name: GaussianScene.load(name) for name in scenes_named(asked)}
        parents = {path.stem: file_sha256(path) for path in (scene, *map(Path, others))}
        edited = edit_scene(GaussianScene.load(scene), asked, others=others, names=parents)
    edited.save(output)
    document = {
        "output": str(output),
        "gaussian_count": edited.gaussian_count,
        "made_labels": [edited.info.label_names[label] for label in edited.info.made_labels],
        "provenance": edited.info.provenance,
    }
    tell(f"wrote {output}: {edited.gaussian_count:,} Gaussians, of {', '.join(parents)}", document, as_json=json)
