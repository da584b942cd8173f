"""Commands on scene files: demo, show, export, import, voxelize, slicer."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import asdict
from operator import gt, lt
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from ultragray.contract import to_dict
from ultragray.datasets.source import SourceOptions
from ultragray.errors import InvalidArgument
from ultragray.phantom.demo import DEMOS, copy_demo_scene
from ultragray.rendering.volumes import SLICE_SUFFIXES, VOLUME_FIELDS, VOLUME_SUFFIXES
from ultragray.scene.info import SceneInfo, read_header
from ultragray_service.cli.options import with_options
from ultragray_service.cli.sweeps import SWEEP_MEANING, read_dataset
from ultragray_service.cli.terminal import (
    COMPRESSED_SUFFIX,
    SCENE_SUFFIX,
    Force,
    Json,
    SceneFile,
    argument,
    check_ending,
    check_file,
    option,
    output_option,
    single,
    tell,
    tell_facts,
    warn,
    working,
)


@single("ultragray demo -o demo.ugr", "ultragray demo abdomen -o abdomen.ugr", "ultragray serve demo.ugr")
def demo(
    which: Annotated[str, argument(f"One of {', '.join(DEMOS)}.", metavar="[WHICH]")] = DEMOS[0],
    output: Annotated[Path, output_option("Scene file to write (.ugr).", default="demo.ugr")] = Path("demo.ugr"),
    force: Force = False,
    json: Json = False,
) -> None:
    """The spine was trained from a simulated sweep, and is there at once. The abdomen (liver, vessels, kidney, ribs,
    gas) is made from labels, which takes half a minute.
    """
    if which not in DEMOS:
        raise InvalidArgument(f"WHICH must be one of {', '.join(DEMOS)}, got {which!r}", field="which")
    check_file(output, [SCENE_SUFFIX], force=force)
    if which == DEMOS[0]:
        copy_demo_scene(output)
    else:
        from ultragray.phantom.recipes import make_abdomen

        with working("making the scene …"):
            make_abdomen().save(output)
    info = read_header(output).info
    tell(
        f"wrote {output}: {info.dataset_name}, {info.gaussian_count:,} Gaussians",
        {"output": str(output), "dataset_name": info.dataset_name, "gaussian_count": info.gaussian_count},
        as_json=json,
    )


@single(
    "ultragray show liver.ugr",
    "ultragray show liver.ugr --json | jq .metrics",
    "ultragray show sweep/  # see also: ultragray check",
)
@with_options
def show(
    file: Annotated[str, argument(f"A scene file (.ugr or .ugz), or a sweep: {SWEEP_MEANING}.", metavar="FILE")],
    json: Json = False,
    *,
    source: SourceOptions,
) -> None:
    """Of a scene: its size, probe, place, metrics and training. Of a sweep: its frames and probe.

    What looks wrong about a sweep is told by `ultragray check`.
    """
    if Path(file).suffix in (SCENE_SUFFIX, COMPRESSED_SUFFIX):
        if source != SourceOptions():
            raise InvalidArgument(f"options of sweeps are not for {file}, which is a scene file", field="source")
        document = describe_scene(Path(file))
    else:
        document = _describe_sweep(file, source)
    tell_facts(document, as_json=json)


def describe_scene(path: Path) -> dict[str, Any]:
    from ultragray.files import file_sha256

    header = read_header(path)
    info, positions = header.info, header.training_poses[:, :3, 3]
    poses: dict[str, Any] = {"count": len(positions)}
    if len(positions):
        poses |= {"position_min_mm": positions.min(axis=0).tolist(), "position_max_mm": positions.max(axis=0).tolist()}
    return {
        "file": str(path),
        "sha256": file_sha256(path),
        "file_bytes": header.file_bytes,
        **asdict(info),
        "confidence": {key: value for key, value in info.confidence.items() if key != "hardness"},
        "probe": None if info.probe is None else to_dict(info.probe),
        "training_poses": poses,
    }


def _describe_sweep(source: str, options: SourceOptions) -> dict[str, Any]:
    dataset = read_dataset(source, options)
    frames = dataset.train
    positions = frames.poses[:, :3, 3]
    return {
        "file": source,
        "name": dataset.name,
        "sha256": dataset.sha256,
        "probe": to_dict(dataset.probe),
        "image_height": frames.height,
        "image_width": frames.width,
        "training_frames": len(dataset.train),
        "held_out_frames": len(dataset.val),
        "position_min_mm": positions.min(axis=0).tolist(),
        "position_max_mm": positions.max(axis=0).tolist(),
    }


EXCHANGED = (".ply", ".pt")  # what `import` reads


@single(
    "ultragray export liver.ugr -o liver.ugz  # a fifth of the bytes",
    "ultragray export liver.ugr -o liver.ply",
    "ultragray export liver.ugr -o released/ckpt.pt  # a folder of its own",
    "ultragray export liver.ugr --page liver-page && python -m http.server -d liver-page",
)
def export(
    scene: SceneFile,
    output: Annotated[
        Path | None,
        output_option(
            "A .ugz file, the scene compressed; a .ply file, which holds everything; or a .pt checkpoint of the "
            "released code, which gets conf.json and poses_train.npy beside it: give it a folder of its own."
        ),
    ] = None,
    page: Annotated[
        Path | None,
        typer.Option(help="A new folder for a web page that renders the scene in the browser, without a service."),
    ] = None,
    force: Force = False,
    json: Json = False,
) -> None:
    """A .ugz file is a scene file itself; `ultragray import` turns the others back into one."""
    if (output is None) == (page is None):
        raise InvalidArgument("give either --output or --page", field="output")
    if page is not None:
        from ultragray.exchange.page import write_page

        files = write_page(scene, page)
        size = sum(path.stat().st_size for path in files)
        words = f"wrote {page}: {len(files)} files, {size / 1e6:.1f} MB; look at it by python -m http.server -d {page}"
        tell(words, {"files": [*map(str, files)], "bytes": size}, as_json=json)
        return
    assert output is not None
    check_ending(output, (COMPRESSED_SUFFIX, *EXCHANGED))
    folder = output.absolute().parent
    check_file(output if output.suffix != ".pt" or folder.exists() else folder, force=force)
    read_header(scene)

    from ultragray import GaussianScene

    loaded = GaussianScene.load(scene)
    facts: dict[str, Any] = {"gaussian_count": loaded.gaussian_count, "files": [str(output)], "notes": []}
    if output.suffix == COMPRESSED_SUFFIX:
        loaded.save(output)
        facts["bytes"] = output.stat().st_size
        share = facts["bytes"] / scene.stat().st_size
        tell(f"wrote {output}: {facts['bytes'] / 1e6:.2f} MB, {share:.0%} of {scene}", facts, as_json=json)
        return
    if output.suffix == ".ply":
        from ultragray.exchange.ply import write_ply

        write_ply(loaded.at_rest(), output)
        facts["training_poses"] = len(loaded.training_poses)
        place = f", {facts['training_poses']} training poses"
    else:
        from ultragray.exchange.checkpoint import export_checkpoint

        written = export_checkpoint(loaded.at_rest(), output, replace=force)
        x, y, z = written.centre_mm
        facts |= {"files": [*map(str, written.files)], "centre_mm": [*map(float, (x, y, z))], "notes": [*written.notes]}
        place = f" about ({x:.2f}, {y:.2f}, {z:.2f}) mm"
    if loaded.tissue is not None:
        facts["notes"].append("its poses are those in the tissue at rest: how tissue followed the probe is left out")
    for note in facts["notes"]:
        typer.secho(f"note: {note}", fg=typer.colors.YELLOW, err=True)
    tell(f"wrote {', '.join(facts['files'])}: {loaded.gaussian_count:,} Gaussians{place}", facts, as_json=json)


_CHECKPOINT = "Checkpoint (.pt)"


@single(
    "ultragray import liver.ply -o liver.ugr",
    "ultragray import ckpt.pt --config conf.json --poses poses_train.npy -o liver.ugr",
    name="import",
)
def import_scene(
    file: Annotated[
        Path, argument("A .ply file that `ultragray export` wrote, or a .pt checkpoint of the released trainer.")
    ],
    output: Annotated[Path, output_option("Scene file to write (.ugr).")],
    force: Force = False,
    json: Json = False,
    config: Annotated[Path | None, option("conf.json of its dataset.", shown=False, panel=_CHECKPOINT)] = None,
    poses: Annotated[
        Path | None,
        option("Its training poses (poses_train.npy); they give the centre.", shown=False, panel=_CHECKPOINT),
    ] = None,
    center: Annotated[
        tuple[float, float, float] | None,
        option("Instead of --poses: the scene centre in mm.", metavar="X Y Z", shown=False, panel=_CHECKPOINT),
    ] = None,
    centered: Annotated[
        bool, option("Instead of --poses: poses will be relative to the centre.", "--centered", panel=_CHECKPOINT)
    ] = False,
    image_height: Annotated[
        int | None,
        option("Height of the training images.", shown="from the images file that conf.json names", panel=_CHECKPOINT),
    ] = None,
) -> None:
    """A checkpoint gets its place in the tracker's frame from the poses that it was trained with."""
    if file.suffix not in EXCHANGED:
        raise InvalidArgument(
            f"import reads {' and '.join(EXCHANGED)} files, got {str(file)!r}; a scene file needs no import",
            field="file",
        )
    if not file.is_file():
        raise InvalidArgument(f"{file}: no such file", field="file")
    of_checkpoint = {
        "--config": config is not None,
        "--poses": poses is not None,
        "--center": center is not None,
        "--centered": centered,
        "--image-height": image_height is not None,
    }
    if file.suffix == ".ply":
        if options := [name for name, is_given in of_checkpoint.items() if is_given]:
            raise InvalidArgument(f"{options[0]} is for checkpoints (.pt), {file.name} is a PLY file", field="file")
    elif config is None:
        raise InvalidArgument("--config must be given: the conf.json of the checkpoint's dataset", field="config")
    elif [poses is not None, center is not None, centered].count(True) != 1:
        raise InvalidArgument(
            "give exactly one of --poses (its training poses), --center X Y Z (the scene centre in mm) and "
            "--centered (poses relative to the centre)",
            field="poses",
        )
    check_file(output, [SCENE_SUFFIX], force=force)

    if config is None:
        from ultragray.exchange.ply import read_ply

        scene = read_ply(file)
        place = f"{len(scene.training_poses)} training poses"
    else:
        from ultragray.exchange.checkpoint import import_checkpoint

        try:
            scene = import_checkpoint(
                file, config=config, poses=poses, center_mm=center, centered=centered, image_height=image_height
            )
        except InvalidArgument as error:
            option = "--image-height: " if error.field == "image_height" else ""
            raise InvalidArgument(f"{option}{error.detail}", field=error.field) from error
        x, y, z = scene.info.centre_mm
        place = f"centre ({x:.2f}, {y:.2f}, {z:.2f}) mm, {scene.info.probe}"
    scene.save(output)
    document = {
        "output": str(output),
        "gaussian_count": scene.gaussian_count,
        "training_poses": len(scene.training_poses),
        "centre_mm": list(scene.info.centre_mm),
    }
    tell(f"wrote {output}: {scene.gaussian_count:,} Gaussians, {place}", document, as_json=json)


RIGHT, DOWN = "1,0,0", "0,0,1"


@single(
    "ultragray voxelize liver.ugr -o liver.nii.gz --spacing-mm 0.5",
    "ultragray voxelize liver.ugr -o bone.nrrd --field attenuation --box-mm=-20:20,-30:30,0:60",
    "ultragray voxelize liver.ugr -o cut.png --plane-mm=-20,0,0 --right 1,0,0 --down 0,0,1 --size-mm 40,60",
)
def voxelize(
    scene: SceneFile,
    output: Annotated[
        Path,
        output_option(
            "A volume: .nii.gz, .nii or .nrrd. A slice (--plane-mm): .png, .npy, or a volume of one layer of voxels."
        ),
    ],
    field: Annotated[str, option(f"One of: {', '.join(VOLUME_FIELDS)}; attenuation is per mm.")] = "echo",
    spacing_mm: Annotated[float, option("Distance of two voxels along each axis.")] = 0.5,
    box_mm: Annotated[
        str | None,
        option(
            "Ranges of x, y and z in the scene's frame, such as -20:20,0:30,-5:45. "
            "Default: the bounds of the Gaussians.",
            shown=False,
        ),
    ] = None,
    plane_mm: Annotated[str | None, option("Corner x,y,z of a slice, instead of a volume.", shown=False)] = None,
    right: Annotated[str, option("Direction of the rows of the slice.")] = RIGHT,
    down: Annotated[str, option("Direction of its columns.")] = DOWN,
    size_mm: Annotated[str | None, option("Its width,height.", shown=False)] = None,
    force: Force = False,
    json: Json = False,
) -> None:
    """The scene without a probe, in its own frame, sampled on a regular grid."""
    if plane_mm is None and output.name.endswith(SLICE_SUFFIXES):
        raise InvalidArgument(
            f"output {output.name!r} is for a slice: give plane_mm and size_mm, or a volume a name that ends in "
            f"{', '.join(VOLUME_SUFFIXES)}",
            field="output",
        )
    if plane_mm is None and (right, down) != (RIGHT, DOWN):
        raise InvalidArgument("right and down are for a slice: give plane_mm, too", field="plane_mm")
    check_file(output, VOLUME_SUFFIXES if plane_mm is None else (*SLICE_SUFFIXES, *VOLUME_SUFFIXES), force=force)
    info = read_header(scene).info

    from ultragray import GaussianScene
    from ultragray.rendering.volume_fields import volume_facts, write_slice, write_volume
    from ultragray.rendering.volumes import VolumeGrid, parse_box, parse_numbers

    if plane_mm is None:
        if size_mm is not None:
            raise InvalidArgument("size_mm is for a slice: give plane_mm, too", field="size_mm")
        grid = VolumeGrid.over_scene(info, box_mm, spacing_mm)
        if box_mm is not None and _is_beyond(info, *parse_box(box_mm)):
            there = ",".join(f"{a:g}:{b:g}" for a, b in zip(info.bounds_min_mm, info.bounds_max_mm, strict=True))
            warn(f"box_mm lies beyond all Gaussians, which are in {there}: is it in mm of the scene's frame?")
    else:
        if size_mm is None or box_mm is not None:
            raise InvalidArgument("a slice needs size_mm, its width,height, and takes no box_mm", field="size_mm")
        directions = parse_numbers(right, 3, "right"), parse_numbers(down, 3, "down")
        size = parse_numbers(size_mm, 2, "size_mm")
        grid = VolumeGrid.on_plane(parse_numbers(plane_mm, 3, "plane_mm"), *directions, size, spacing_mm)
    with working(f"sampling {' x '.join(map(str, grid.shape))} points …"):
        loaded = GaussianScene.load(scene)
        (write_slice if output.name.endswith(SLICE_SUFFIXES) else write_volume)(output, loaded, field, grid)
    document = {"file": str(output), **volume_facts(info, field, grid)}
    tell(f"wrote {output}: {field}, {' x '.join(map(str, grid.shape))} at {spacing_mm:g} mm", document, as_json=json)


def _is_beyond(info: SceneInfo, low: Sequence[float], high: Sequence[float]) -> bool:  # [3] mm both
    return any(map(lt, high, info.bounds_min_mm)) or any(map(gt, low, info.bounds_max_mm))


SUFFIX, VOLUME_SUFFIX = ".mrml", "-echo.nii.gz"


@single(
    "ultragray slicer scenes/liver.ugr -o liver.mrml",
    "ultragray slicer scenes/liver.ugr -o liver.mrml --igtl-address 10.0.0.5:18944",
)
def slicer(
    scene: SceneFile,
    output: Annotated[Path, output_option(f"{SUFFIX}; the volume NAME{VOLUME_SUFFIX} is written beside it.")],
    igtl_address: Annotated[str, option("HOST:PORT of the service's OpenIGTLink.")] = "127.0.0.1:18944",
    spacing_mm: Annotated[float, option("Distance of two voxels of the volume.")] = 1.0,
    force: Force = False,
    json: Json = False,
) -> None:
    """Write a scene file of 3D Slicer: a connector to the service, a pose that it sends, and the scene as a volume."""
    from ultragray_service.igtl.routes import device_of, image_name

    host, port = _host_and_port(igtl_address)
    volume = output.with_name(output.name.removesuffix(SUFFIX) + VOLUME_SUFFIX)
    check_file(output, (SUFFIX,), force=force)
    check_file(volume, force=force)
    header = read_header(scene)
    poses = header.training_poses
    pose = poses[len(poses) // 2] if len(poses) else np.eye(4)

    from ultragray import GaussianScene
    from ultragray.exchange.slicer import slicer_scene
    from ultragray.files import write_whole
    from ultragray.rendering.volume_fields import write_volume
    from ultragray.rendering.volumes import VolumeGrid

    grid = VolumeGrid.over_scene(header.info, None, spacing_mm)
    with working(f"sampling {' x '.join(map(str, grid.shape))} points …"):
        write_volume(volume, GaussianScene.load(scene), "echo", grid)
    device = device_of(scene.stem)
    write_whole(output, slicer_scene(host, port, device, pose, volume.name))
    image = image_name(device)
    document = {"file": str(output), "volume": str(volume), "device": device, "image": image, "address": igtl_address}
    tell(f"wrote {output} and {volume}: {device} is sent to {igtl_address}, {image} comes back", document, as_json=json)


def _host_and_port(address: str) -> tuple[str, int]:
    match = re.fullmatch(r"(?P<host>[^\s:]+|\[[0-9A-Fa-f:.]+\]):(?P<port>\d{1,5})", address)
    if match is None or not 1 <= int(match["port"]) <= 65535:
        raise InvalidArgument(
            f"igtl_address must be HOST:PORT such as 127.0.0.1:18944, got {address[:80]!r}", field="igtl_address"
        )
    return match["host"].strip("[]"), int(match["port"])
