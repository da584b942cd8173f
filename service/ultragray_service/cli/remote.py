"""What a running service keeps, over HTTP: commands of scenes, datasets, registrations and workers."""

from __future__ import annotations

import base64
import contextlib
import json
import tempfile
import zipfile
from collections.abc import Callable, Iterator, Mapping
from http.client import HTTPMessage
from pathlib import Path
from typing import Annotated, Any
from urllib.parse import urlencode

import numpy as np

from ultragray.contract import from_dict, to_dict
from ultragray.datasets.source import COMPANIONS, UPLOAD_OPTIONS, UPLOADED_FORMATS, SourceOptions, find_source
from ultragray.errors import DatasetInvalid, InvalidArgument
from ultragray.exchange.poses import load_poses
from ultragray.files import write_whole
from ultragray.geometry.pose import check_poses
from ultragray.geometry.probe import FloatArray, Probe
from ultragray.rendering.pixels import png_file
from ultragray.rendering.settings import FrameSettings, RenderSettings
from ultragray.samplers import Sampler
from ultragray.scene.info import DEFAULT_WITHIN_MM, read_header
from ultragray.scene.label_maps import parse_names, read_label_map, read_painted
from ultragray.scene.recipes import read_recipe
from ultragray_service.cli.connection import CHECK_TIMEOUT_S, Connection, Resource, route, with_connection
from ultragray_service.cli.editing import (
    RECIPE_FIELDS,
    CtOption,
    EditOptions,
    LabelsArgument,
    TissueOption,
    left_out,
)
from ultragray_service.cli.labels import FramesOption, MapOption, NamesOption, WithinOption, check_source
from ultragray_service.cli.options import FieldsOf, poses_option, with_options
from ultragray_service.cli.sweeps import SWEEP_MEANING
from ultragray_service.cli.terminal import (
    COMPRESSED_SUFFIX,
    OR_A_FOLDER,
    SCENE_SUFFIX,
    Force,
    Json,
    argument,
    check_ending,
    check_file,
    check_folder,
    command_group,
    counted,
    examples,
    frames_in_words,
    is_folder_name,
    option,
    output_option,
    tell,
    transferred,
    warn,
)
from ultragray_workers.jobs.demand import GB

MEDIA_TYPES = {".png": "image/png", ".jpg": "image/jpeg", ".npz": "application/x-npz"}
SUFFIXES = tuple(MEDIA_TYPES)
FRAMES_FILE = "frames.json"


def checked_kind(output: Path, settings: FrameSettings, *, force: bool) -> str | None:
    """The ending of the output, of SUFFIXES; None: a folder. Raises InvalidArgument where it cannot be written."""
    if is_folder_name(output):
        check_folder(output, force=force)
        return None
    check_ending(output, SUFFIXES, otherwise=OR_A_FOLDER)
    check_file(output, force=force)
    if output.suffix != ".npz" and len(settings.outputs) != 1:
        raise InvalidArgument(
            f"a picture holds one output, got {', '.join(settings.outputs)}: write a .npz file or a folder",
            field="outputs",
        )
    return output.suffix


def _poses(
    connection: Connection, scene: str, base: FloatArray | None, sampler: Sampler | None, probe: Probe | None
) -> FloatArray:  # [C, 4, 4] mm
    """The poses of a file, or those that a sampler makes; without either the middle training pose."""
    if sampler is None and base is not None:
        return base
    if base is None:  # at most 10,000 training poses
        answer = connection.json("GET", route("scenes", scene, "training-poses"))
        base = check_poses(np.array(answer["poses"], np.float64).reshape(-1, 4, 4))
    if not len(base):
        raise InvalidArgument("--poses must be given: the scene holds no training poses", field="poses")
    if sampler is None:
        middle: FloatArray = base[len(base) // 2][None]
        return middle
    if probe is None:
        document = connection.json("GET", route("scenes", scene))["probe"]
        if document is None:
            raise InvalidArgument("--probe must be given: the scene does not know its own", field="probe")
        probe = from_dict(Probe, document)
    return sampler.poses(base, probe)


def _write_folder(connection: Connection, scene: str, folder: Path, settings: dict[str, Any], poses: FloatArray) -> str:
    """A PNG for each pose and output, and a file that describes the frames; their shape as a header tells it."""
    shape, documents = "", []
    with counted("rendering", len(poses)) as report:
        for number, pose in enumerate(poses):
            for output in settings["outputs"]:
                body = {**settings, "outputs": [output], "pose": _pose(pose)}
                data, headers = _rendered(connection, scene, body, MEDIA_TYPES[".png"])
                folder.mkdir(parents=True, exist_ok=True)  # only now: a refusal leaves no folder
                write_whole(folder / f"frame_{number:05d}_{output}.png", data)
            shape = headers["x-ultragray-shape"]
            about = {name: json.loads(headers[f"x-ultragray-{name}"]) for name in ("pose", "extrapolation")}
            documents.append({"frame": number, "pose": about["pose"], **about["extrapolation"]})
            report(number + 1)
    write_whole(folder / FRAMES_FILE, json.dumps(documents))
    return shape


def _rendered(connection: Connection, scene: str, body: dict[str, Any], media_type: str) -> tuple[bytes, HTTPMessage]:
    """Frames as the service encoded them, and what its headers say about them."""
    with connection.open("POST", route("scenes", scene, "render"), body, accept=media_type) as answer:
        return connection.whole(answer), answer.headers


def _pose(pose: FloatArray) -> dict[str, Any]:  # [4, 4] mm
    return {"matrix": pose.tolist()}


ARCHIVE_SUFFIXES = (".zip", ".tar", ".tar.gz", ".tgz")


def _time(text: str | None) -> str:
    return (text or "")[:19].replace("T", " ")


def _owner(item: dict[str, Any]) -> str:
    return f"{item.get('owner') or ''}{' (private)' if item.get('private') else ''}"


def _text_of(key: str) -> Callable[[dict[str, Any]], str]:
    return lambda item: str(item[key] or "")


def _number_of(key: str, layout: str, unit: float | None = None) -> Callable[[dict[str, Any]], str]:
    def text(item: dict[str, Any]) -> str:
        value = item.get(key)
        return "" if value is None else format(value if unit is None else value / unit, layout)

    return text


def _size(item: dict[str, Any]) -> str:
    return "" if item.get("image_height") is None else f"{item['image_width']}x{item['image_height']}"


NameArgument = Annotated[str, argument("Name of the scene.", metavar="NAME")]
scenes_app = command_group("The service renders them for clients; `ultragray render` does without a service.")
_scenes = Resource(
    scenes_app,
    "scenes",
    "liver",
    {
        "name": _text_of("name"),
        "Gaussians": _number_of("gaussian_count", ","),
        "image": _size,
        "MB": _number_of("file_bytes", ",.1f", 1e6),
        "loaded": lambda scene: "yes" if scene["loaded"] else "no",
        "owner": _owner,
        "error": lambda scene: scene["error"]["detail"] if "error" in scene else "",
    },
)
_scenes.add_list("List the scenes by name.")
_scenes.add_show(
    "Print probe, place, training poses and metrics of a scene; mm, in the frame of the training sweep.",
    "ultragray scenes show demo --json | jq .probe",
)


@scenes_app.command(
    "upload", epilog=examples("ultragray scenes upload liver.ugr", "ultragray scenes upload a.ugr --name liver")
)
@with_connection
def upload_scene(
    connection: Connection,
    file: Annotated[Path, argument("Scene file (.ugr or .ugz).")],
    name: Annotated[str | None, option("Name of the scene.", shown="that of the file")] = None,
    private: Annotated[bool, option("Others do not see it.", "--private")] = False,
    json: Json = False,
) -> None:
    """Have the service take a scene file in and render it."""
    size = read_header(file).file_bytes
    called = file.stem if name is None else name
    with transferred(f"uploading {called}") as begin:
        to = route("scenes", called, suffix="?private=true" if private else "")
        scene, _ = connection.upload(to, file, begin(size))
    tell(f"uploaded {called}: {scene['gaussian_count']:,} Gaussians", scene, as_json=json)


@scenes_app.command(
    "download",
    epilog=examples("ultragray scenes download demo", "ultragray scenes download demo -o demo.ugz"),
)
@with_connection
def download_scene(
    connection: Connection,
    name: NameArgument,
    output: Annotated[
        Path | None, output_option("Scene file to write (.ugr, or .ugz: compressed).", default="NAME.ugr, here")
    ] = None,
    force: Force = False,
    json: Json = False,
) -> None:
    """Download a scene file."""
    path = Path(f"{name}{SCENE_SUFFIX}") if output is None else output
    check_file(path, [SCENE_SUFFIX, COMPRESSED_SUFFIX], force=force)
    with transferred(f"downloading {name}") as begin:
        form = "file" if path.suffix == SCENE_SUFFIX else "file.ugz"
        size = connection.download(route("scenes", name, form), path, begin)
    tell(f"wrote {path}: {size:,} bytes", {"output": str(path), "bytes": size}, as_json=json)


@scenes_app.command(
    "label",
    epilog=examples(
        "ultragray scenes label liver --into liver-labelled --map segmentation.nii.gz --names 1=vessel,2=tumour",
        "ultragray scenes label liver --into liver-labelled --frames painted.npz --names 1=vessel --replace",
    ),
)
@with_connection
def label_scene(
    connection: Connection,
    name: NameArgument,
    into: Annotated[str, option("Name of the scene to make.", shown=False)],
    label_map: MapOption = None,
    frames: FramesOption = None,
    names: NamesOption = "",
    within_mm: WithinOption = DEFAULT_WITHIN_MM,
    registration: Annotated[
        str | None, option("Name of the registration that leads the map, or poses, into the scene.", shown=False)
    ] = None,
    replace: Annotated[
        bool, option("INTO may be there, with the same Gaussians: it gets the labels.", "--replace")
    ] = False,
    private: Annotated[bool, option("Others do not see the scene that is made.", "--private")] = False,
    json: Json = False,
) -> None:
    """Have the service label the Gaussians of a scene, as another scene."""
    check_source(label_map, frames)
    body = {"into": into, "replace": replace, "private": private, "within_mm": within_mm, "registration": registration}
    body["label_names"] = parse_names(names)
    if label_map is not None:
        read_label_map(label_map)  # what is none is refused before it travels
        suffix, body["label_map"] = ":label-by-map", _base64(label_map.read_bytes())
    elif frames is not None:
        painted, suffix = read_painted(frames), ":label"
        body["frames"] = [
            {"pose": _pose(pose), "labels": _base64(png_file(labels))}
            for pose, labels in zip(painted.poses, painted.labels, strict=True)
        ]
    scene = connection.json("POST", route("scenes", name, suffix=suffix), body)
    tell(f"labelled {name} as {into}: {', '.join(scene['label_names'].values())}", scene, as_json=json)


@scenes_app.command(
    "edit",
    epilog=examples(
        "ultragray scenes edit liver --into liver-cyst --insert cyst --at-mm 0,0,30",
        "ultragray scenes edit left --into whole --merge right",
    ),
)
@with_options
@with_connection
def edit_scene(
    connection: Connection,
    name: NameArgument,
    into: Annotated[str, option("Name of the scene to make.", shown=False)],
    private: Annotated[bool, option("Others do not see the scene that is made.", "--private")] = False,
    json: Json = False,
    *,
    edits: EditOptions,
) -> None:
    """Have the service edit a scene, as another one that names its parents. Merged scenes are the service's, too."""
    body = {"into": into, "private": private, "edits": to_dict(edits.listed(), with_none=False)}
    scene = connection.json("POST", route("scenes", name, suffix=":edit"), body)
    words = f"made {into}: {scene['gaussian_count']:,} Gaussians, of {', '.join(scene['parents'])}"
    tell(words + left_out(_edits_of(scene)), scene, as_json=json)


def _edits_of(scene: Mapping[str, Any]) -> list[dict[str, Any]]:
    return [json.loads(edit) for edit in scene["edits"]]


@scenes_app.command(
    "from-labels",
    epilog=examples("ultragray scenes from-labels ct_labels.nii.gz --into liver --tissue liver.toml"),
)
@with_options
@with_connection
def make_scene(
    connection: Connection,
    into: Annotated[str, option("Name of the scene to make.", shown=False)],
    labels: LabelsArgument = None,
    tissue: TissueOption = None,
    ct: CtOption = None,
    private: Annotated[bool, option("Others do not see the scene that is made.", "--private")] = False,
    json: Json = False,
    *,
    recipe: Annotated[dict[str, Any], RECIPE_FIELDS],
) -> None:
    """Have the service make a scene that nobody recorded, from a label map or meshes."""
    body = to_dict(read_recipe(tissue, labels, ct, **recipe), with_none=False)
    scene = connection.json("POST", route("scenes", suffix=":from-labels"), {**body, "into": into, "private": private})
    label_names = ", ".join(scene["made_labels"])
    tell(f"made {into}: {scene['gaussian_count']:,} Gaussians, {label_names}", scene, as_json=json)


def _base64(data: bytes) -> str:
    return base64.b64encode(data).decode()


_scenes.add_delete("Delete a scene that was uploaded or trained there; scenes of the data folder stay.")


@scenes_app.command(
    "render",
    epilog=examples(
        "ultragray scenes render demo -o frame.png  # at the middle training pose",
        "ultragray scenes render demo -o frames.npz --poses path.npy --outputs bmode,echo",
        "ultragray scenes render demo -o frames.npz --poses flange.npy --registration robot",
        "ultragray scenes render demo -o pictures/ --sampler fan --tilt-deg 20 --step-deg 2",
    ),
)
@with_options
@with_connection
def render_scene(
    connection: Connection,
    name: NameArgument,
    output: Annotated[Path, output_option(f"A file ({', '.join(SUFFIXES)}), or a folder for PNGs.")],
    force: Force = False,
    json: Json = False,
    poses: Annotated[Path | None, poses_option(default="the middle training pose")] = None,
    *,
    sampler: Sampler | None,
    settings: FrameSettings,
    of_poses: Annotated[dict[str, Any], FieldsOf(RenderSettings, "registration")],
) -> None:
    """Have the service render a frame or some frames. Many thousands are a job: `ultragray jobs submit render`."""
    suffix, registration = checked_kind(output, settings, force=force), of_poses.get("registration")
    if registration is not None and (poses is None or sampler is not None):
        raise InvalidArgument(
            "a registration leads the poses of a file, which must be given with --poses and without --sampler; "
            "ultragray jobs submit render samples about such poses",
            field="registration",
        )
    chosen = _poses(connection, name, None if poses is None else load_poses(poses), sampler, settings.probe)
    body = {**to_dict(settings, with_none=False), "outputs": list(settings.outputs)}
    if registration is not None:
        body["registration"] = registration
    if suffix is None:
        shape = _write_folder(connection, name, output, body, chosen)
    elif suffix != ".npz" and len(chosen) != 1:
        raise InvalidArgument(
            f"a picture holds one frame, there are {len(chosen)} poses: write a .npz file or a folder", field="output"
        )
    else:
        of_many = {"pose": _pose(chosen[0])} if len(chosen) == 1 else {"poses": list(map(_pose, chosen))}
        data, headers = _rendered(connection, name, {**body, **of_many}, MEDIA_TYPES[suffix])
        write_whole(output, data)
        shape = headers["x-ultragray-shape"]
    _, _, height, width = map(int, shape.split(","))
    facts = {"frames": len(chosen), "height": height, "width": width, "outputs": body["outputs"]}
    what = f"{frames_in_words(len(chosen))} of {height}x{width}, {', '.join(settings.outputs)}"
    tell(f"wrote {output}: {what}", {"output": str(output), "scene": name, **facts}, as_json=json)


datasets_app = command_group("They are checked when they arrive; `ultragray jobs submit train NAME` trains from one.")
_datasets = Resource(
    datasets_app,
    "datasets",
    "liver",
    {
        "name": _text_of("name"),
        "format": _text_of("kind"),
        "training": _number_of("train_frames", ""),
        "held out": _number_of("val_frames", ""),
        "pixels": lambda record: f"{record['width']}x{record['height']}",
        "MB": _number_of("bytes", ",.1f", 1e6),
        "created": lambda record: _time(record["created_at"]),
        "owner": _owner,
    },
)
_datasets.add_list("List the datasets by name.")
_datasets.add_show("Print size, probe and split of a dataset, and what its check warned of.")


@datasets_app.command(
    "upload",
    epilog=examples(
        "ultragray datasets upload sweep/  # a folder is zipped on the way",
        "ultragray datasets upload scan.igs.mha --device-set plus.xml --name liver",
        "ultragray datasets upload sweep.zip --val-frames 80:100 --private",
    ),
)
@with_options
@with_connection
def upload_dataset(
    connection: Connection,
    sweep: Annotated[Path, argument(f"An archive (.zip, .tar), or {SWEEP_MEANING}.", metavar="SWEEP")],
    name: Annotated[str | None, option("Name of the dataset.", shown="that of the file or folder")] = None,
    private: Annotated[bool, option("Others do not see it.", "--private")] = False,
    json: Json = False,
    *,
    source: SourceOptions,
) -> None:
    """Upload a sweep; the service checks it as `ultragray check` does, and keeps it."""
    called = _name_of(sweep) if name is None else name
    options = {key: str(value) for key in UPLOAD_OPTIONS if (value := getattr(source, key)) is not None}
    query = urlencode({**options, **({"private": "true"} if private else {})})
    companions = {name: path for name in COMPANIONS if (path := getattr(source, name)) is not None}
    with archive_of(sweep, companions) as archive, transferred(f"uploading {called}") as begin:
        to = route("datasets", called, suffix=f"?{query}" if query else "")
        record, is_new = connection.upload(to, archive, begin(archive.stat().st_size))
    for text in record["warnings"]:
        warn(text)
    frames = f"{record['train_frames']} training and {record['val_frames']} held-out frames"
    was = f"uploaded {called}" if is_new else f"{called} is there already, the same"
    tell(f"{was}: {frames} of {record['width']}x{record['height']}", record, as_json=json)


_datasets.add_delete("Delete a dataset that no job needs.")


def _name_of(sweep: Path) -> str:
    path = sweep.resolve()
    name = (path.parent if _is_of_a_folder(path) else path).name.split(".")[0]
    if not name:
        raise InvalidArgument(f"--name must be given: {sweep} has none", field="name")
    return name


@contextlib.contextmanager
def archive_of(source: Path, companions: Mapping[str, Path] | None = None) -> Iterator[Path]:
    """An archive of what a source is: itself, or a zip of the folder or of the sequence with the files that it needs.

    Files that are options go into the archive too. Raises DatasetInvalid where there is no such source or it is none,
    and InvalidArgument for such files beside an archive.
    """
    if source.name.lower().endswith(ARCHIVE_SUFFIXES) and source.is_file():
        for name in companions or ():
            raise InvalidArgument(f"--{name.replace('_', '-')} must be in the archive {source}", field=name)
        yield source
        return
    files = [*_files_of(source), *(companions or {}).values()]
    with tempfile.TemporaryDirectory(prefix="ultragray-upload-") as folder:
        archive = Path(folder, "upload.zip")
        with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED, compresslevel=1, strict_timestamps=False) as zip_file:
            for path in files:
                below = source if source.is_dir() else source.parent
                inner = path.relative_to(below) if path.is_relative_to(below) else Path(path.name)
                zip_file.write(path, inner.as_posix())
        yield archive


def _files_of(source: Path) -> list[Path]:
    if source.is_dir():
        find_source(source)
        return sorted(path for path in source.rglob("*") if path.is_file() and not _is_hidden(path, source))
    if not source.is_file():
        raise DatasetInvalid(f"{source}: no such file or folder")
    if _is_of_a_folder(source):
        return _files_of(source.parent)
    format = next((one for one in UPLOADED_FORMATS if one.is_file(source)), None)
    if format is None:
        expected = "; ".join(one.meaning for one in UPLOADED_FORMATS)
        raise DatasetInvalid(f"{source}: an upload is an archive ({', '.join(ARCHIVE_SUFFIXES)}) or one of: {expected}")
    stems = {source.stem, source.name.split(".")[0]}  # of sweep.igs.mhd: sweep.igs and sweep
    beside = (source.with_name(f"{stem}{ending}") for stem in stems for ending in format.beside)
    return [source, *sorted(path for path in beside if path.is_file())]


def _is_of_a_folder(source: Path) -> bool:
    return any(one.is_folder and one.is_file(source) for one in UPLOADED_FORMATS)


def _is_hidden(path: Path, folder: Path) -> bool:
    """Whether a file, or a folder on the way to it, is hidden: no part of a sweep, such as .git."""
    return any(part.startswith(".") for part in path.relative_to(folder).parts)


recordings_app = command_group("Datasets that are still open; `ultragray live` records into one.")
_recordings = Resource(recordings_app, "recordings", "liver")
_recordings.add_show("Print how far a recording is.")
_recordings.add_action(
    "finish",
    "Make a recording a dataset, checked as an upload is.",
    lambda record: (
        f"recorded {record['name']}: {record['train_frames']} training and {record['val_frames']} held-out frames"
    ),
    CHECK_TIMEOUT_S,
)
_recordings.add_delete("Give up a recording and its frames.")


registrations_app = command_group("Requests that name one have poses in the robot's or tracker's own frame.")
_registrations = Resource(
    registrations_app,
    "registrations",
    "robot",
    {
        "name": _text_of("name"),
        "scene": _text_of("scene"),
        "residual mm": _number_of("residual_mm", ".2g"),
        "changed": lambda item: _time(item["changed_at"]),
        "owner": _text_of("owner"),
    },
)
_registrations.add_list("List the registrations by name.")
_registrations.add_show("Print both links of a registration, mm, and how exact it is.")


@registrations_app.command(
    "upload",
    epilog=examples(
        "ultragray registrations upload robot.json --scene demo",
        "ultragray registrations upload robot.json --scene demo --name room-2",
    ),
)
@with_connection
def upload_registration(
    connection: Connection,
    file: Annotated[Path, argument("File of `ultragray calibrate` (.json).")],
    scene: Annotated[str, option("Name of the scene that it leads into.", shown=False)],
    name: Annotated[str | None, option("Name of the registration.", shown="that of the file")] = None,
    json: Json = False,
) -> None:
    """Have the service keep a registration, in place of one of that name which is yours."""
    from ultragray.geometry.registration import load_registration

    called = file.stem if name is None else name
    content = {"scene": scene, **to_dict(load_registration(file), with_none=False)}
    registration = connection.json("PUT", route("registrations", called), content)
    tell(f"uploaded {called}, of the scene {registration['scene']}", registration, as_json=json)


_registrations.add_delete("Forget a registration. Jobs that were accepted with it keep it.")


def _worker_in_words(worker: dict[str, Any]) -> str:
    return f"{worker['name']} {worker['state']}" + (f", at the job {worker['job']}" if worker["job"] else "")


workers_app = command_group("They obey within two seconds; `ultragray worker` starts one.")
_workers = Resource(
    workers_app,
    "workers",
    "gpu-1",
    {
        **{key: _text_of(key) for key in ("name", "state", "job", "host", "pid")},
        "devices": lambda worker: ", ".join(
            f"{device['name']} {device['memory_bytes'] / GB:.0f} GB" for device in worker["devices"]
        ),
        "labels": lambda worker: " ".join(f"{name}={value}" for name, value in worker["labels"].items()),
        "version": _text_of("version"),
        "started": lambda worker: _time(worker["started_at"]),
        "last sign": lambda worker: "" if (beat_s := worker["seconds_since_beat"]) is None else f"{beat_s:.0f} s ago",
    },
)
_workers.add_list("List the workers, also those that were lost within a day.", "ultragray workers list --json")
_workers.add_action(
    "pause",
    "Let a worker take no more jobs; it ends the one at hand. Holds until resume, restarts included.",
    _worker_in_words,
)
_workers.add_action(
    "drain",
    "As pause, but a training at hand goes back into the queue at once, and on elsewhere from its checkpoint.",
    _worker_in_words,
)
_workers.add_action("resume", "Let a worker take jobs again.", _worker_in_words)
