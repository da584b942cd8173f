"""`ultragray scenes …`, `datasets …`, `registrations …` and `workers …`: what a running service keeps, over HTTP.

All have `list`; all but workers have `show` and `delete`, which `_Resource` makes.
"""

from __future__ import annotations

import contextlib
import tempfile
import zipfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any
from urllib.parse import urlencode

import typer

from ultragray.contract import to_dict
from ultragray.datasets.source import COMPANIONS, UPLOAD_OPTIONS, UPLOADED_FORMATS, SourceOptions
from ultragray.errors import DatasetInvalid, InvalidArgument
from ultragray.rendering.settings import FrameSettings, RenderSettings
from ultragray.samplers import Sampler
from ultragray.scene.info import read_header
from ultragray_service.cli.connection import Connection, route, with_connection
from ultragray_service.cli.options import FieldsOf, poses_option, with_options
from ultragray_service.cli.remote_frames import SUFFIXES, RenderRequest, checked_kind
from ultragray_service.cli.sweeps import SWEEP_MEANING
from ultragray_service.cli.terminal import (
    SCENE_SUFFIX,
    Force,
    Json,
    argument,
    check_file,
    command_group,
    examples,
    frames_in_words,
    option,
    output_option,
    print_facts,
    print_table,
    tell,
    to_json,
    transferred,
    warn,
)
from ultragray_workers.jobs.demand import GB

ARCHIVE_SUFFIXES = (".zip", ".tar", ".tar.gz", ".tgz")


@dataclass(frozen=True)
class _Resource:
    """A kind of things that a service keeps by name, and the commands that all such kinds have."""

    app: typer.Typer
    kind: str  # plural: the command, the route, and the key of a list
    thing: str
    columns: tuple[str, ...]
    row: Callable[[dict[str, Any]], tuple[str, ...]]

    def add_list(self, meaning: str, *more: str) -> None:
        """`list`: a table, or the documents of all."""
        line = f"ultragray {self.kind} list"

        @self.app.command("list", help=meaning, epilog=examples(line, *more or (f"{line} --json | jq '.[].name'",)))
        @with_connection
        def list_all(connection: Connection, json: Json = False) -> None:
            found = connection.listed(f"/v1/{self.kind}", self.kind)
            if json:
                typer.echo(to_json(found))
            else:
                print_table(self.columns, map(self.row, found))

    def add_show(self, example: str, meaning: str, *more: str) -> None:
        """`show`: the facts of one."""

        def show(connection: Connection, name: str, json: Json = False) -> None:
            found = connection.json("GET", route(self.kind, name))
            if json:
                typer.echo(to_json(found))
            else:
                print_facts(found)

        self._add("show", show, meaning, f"ultragray {self.kind} show {example}", *more)

    def add_delete(self, example: str, meaning: str) -> None:
        """`delete`."""

        def delete(connection: Connection, name: str, json: Json = False) -> None:
            connection.json("DELETE", route(self.kind, name))
            tell(f"{name} deleted", {"deleted": name}, as_json=json)

        self._add("delete", delete, meaning, f"ultragray {self.kind} delete {example}")

    def _add(self, name: str, command: Callable[..., None], meaning: str, *lines: str) -> None:
        """Adds a command that takes the name of one."""
        argument = typer.Argument(metavar="NAME", help=f"Name of the {self.thing}.", show_default=False)
        command.__annotations__["name"] = Annotated[str, argument]
        self.app.command(name, help=meaning, epilog=examples(*lines))(with_connection(command))


def _time(text: str | None) -> str:
    return (text or "")[:19].replace("T", " ")


def _owner(found: dict[str, Any]) -> str:
    return f"{found.get('owner') or ''}{' (private)' if found.get('private') else ''}"


# Scenes.


def _scene_row(scene: dict[str, Any]) -> tuple[str, ...]:
    count, size, height = scene.get("gaussian_count"), scene.get("file_bytes"), scene.get("image_height")
    return (
        scene["name"],
        "" if count is None else f"{count:,}",
        "" if height is None else f"{scene['image_width']}x{height}",
        "" if size is None else f"{size / 1e6:,.1f}",
        "yes" if scene["loaded"] else "no",
        _owner(scene),
        scene["error"]["detail"] if "error" in scene else "",
    )


scenes_app = command_group("The service renders them for clients; `ultragray render` does without a service.")
_scenes = _Resource(
    scenes_app, "scenes", "scene", ("name", "Gaussians", "image", "MB", "loaded", "owner", "error"), _scene_row
)
_scenes.add_list("List the scenes by name.")
_scenes.add_show(
    "demo",
    "Print probe, place, training poses and metrics of a scene; mm, in the frame of the training sweep.",
    "ultragray scenes show demo --json | jq .probe",
)


@scenes_app.command(
    "upload", epilog=examples("ultragray scenes upload liver.ugr", "ultragray scenes upload a.ugr --name liver")
)
@with_connection
def upload_scene(
    connection: Connection,
    file: Annotated[Path, argument("Scene file (.ugr).", shown=False)],
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


@scenes_app.command("download", epilog=examples("ultragray scenes download demo -o demo.ugr"))
@with_connection
def download_scene(
    connection: Connection,
    name: Annotated[str, argument("Name of the scene.", metavar="NAME", shown=False)],
    output: Annotated[Path | None, output_option("Scene file to write (.ugr).", default="NAME.ugr, here")] = None,
    force: Force = False,
    json: Json = False,
) -> None:
    """Download a scene file."""
    path = Path(f"{name}{SCENE_SUFFIX}") if output is None else output
    check_file(path, [SCENE_SUFFIX], force=force)
    with transferred(f"downloading {name}") as begin:
        size = connection.download(route("scenes", name, "file"), path, begin)
    tell(f"wrote {path}: {size:,} bytes", {"output": str(path), "bytes": size}, as_json=json)


_scenes.add_delete("liver", "Delete a scene that was uploaded or trained there; scenes of the data folder stay.")


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
    name: Annotated[str, argument("Name of the scene.", metavar="NAME", shown=False)],
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
    from ultragray_service.cli.remote_frames import render_remotely

    suffix = checked_kind(output, settings, force=force)
    request = RenderRequest(name, output, suffix, poses, sampler, of_poses.get("registration"), settings)
    document = render_remotely(connection, request)
    size = f"{document['height']}x{document['width']}"
    tell(
        f"wrote {output}: {frames_in_words(document['frames'])} of {size}, {', '.join(settings.outputs)}",
        document,
        as_json=json,
    )


# Datasets.


def _dataset_row(record: dict[str, Any]) -> tuple[str, ...]:
    return (
        record["name"],
        record["kind"],
        str(record["train_frames"]),
        str(record["val_frames"]),
        f"{record['width']}x{record['height']}",
        f"{record['bytes'] / 1e6:,.1f}",
        _time(str(record["created_at"])),
        _owner(record),
    )


datasets_app = command_group("They are checked when they arrive; `ultragray jobs submit train NAME` trains from one.")
_datasets = _Resource(
    datasets_app,
    "datasets",
    "dataset",
    ("name", "format", "training", "held out", "pixels", "MB", "created", "owner"),
    _dataset_row,
)
_datasets.add_list("List the datasets by name.")
_datasets.add_show("liver", "Print size, probe and split of a dataset, and what its check warned of.")


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
    sweep: Annotated[Path, argument(f"An archive (.zip, .tar), or {SWEEP_MEANING}.", metavar="SWEEP", shown=False)],
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


_datasets.add_delete("liver", "Delete a dataset that no job needs.")


def _name_of(sweep: Path) -> str:
    found = sweep.resolve()
    name = (found.parent if _is_of_a_folder(found) else found).name.split(".")[0]
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
        with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED, compresslevel=1, strict_timestamps=False) as made:
            for path in files:
                below = source if source.is_dir() else source.parent
                name = path.relative_to(below) if path.is_relative_to(below) else Path(path.name)
                made.write(path, name.as_posix())
        yield archive


def _files_of(source: Path) -> list[Path]:
    if source.is_dir():
        files = sorted(path for path in source.rglob("*") if path.is_file() and not _is_hidden(path, source))
        if not any(one.is_file(path) for one in UPLOADED_FORMATS for path in files):
            expected = "; ".join(one.meaning for one in UPLOADED_FORMATS)
            raise DatasetInvalid(f"{source}: no sweep lies in this folder; expected is one of: {expected}")
        return files
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


# Registrations.


def _registration_row(found: dict[str, Any]) -> tuple[str, ...]:
    residual_mm = found["residual_mm"]
    return (
        found["name"],
        found["scene"],
        "" if residual_mm is None else f"{residual_mm:.2g}",
        _time(str(found["changed_at"])),
        found["owner"] or "",
    )


registrations_app = command_group("Requests that name one have poses in the robot's or tracker's own frame.")
_registrations = _Resource(
    registrations_app,
    "registrations",
    "registration",
    ("name", "scene", "residual mm", "changed", "owner"),
    _registration_row,
)
_registrations.add_list("List the registrations by name.")
_registrations.add_show("robot", "Print both links of a registration, mm, and how exact it is.")


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
    file: Annotated[Path, argument("File of `ultragray calibrate` (.json).", shown=False)],
    scene: Annotated[str, option("Name of the scene that it leads into.", shown=False)],
    name: Annotated[str | None, option("Name of the registration.", shown="that of the file")] = None,
    json: Json = False,
) -> None:
    """Have the service keep a registration, in place of one of that name which is yours."""
    from ultragray.geometry.registration import load_registration

    called = file.stem if name is None else name
    content = {"scene": scene, **to_dict(load_registration(file), with_none=False)}
    kept = connection.json("PUT", route("registrations", called), content)
    tell(f"uploaded {called}, of the scene {kept['scene']}", kept, as_json=json)


_registrations.add_delete("robot", "Forget a registration. Jobs that were accepted with it keep it.")


# Workers.


def _worker_row(worker: dict[str, Any]) -> tuple[str, ...]:
    beat_s = worker["seconds_since_beat"]
    return (
        worker["name"],
        worker["state"],
        worker["job"] or "",
        worker["host"],
        str(worker["pid"]),
        ", ".join(f"{device['name']} {device['memory_bytes'] / GB:.0f} GB" for device in worker["devices"]),
        " ".join(f"{name}={value}" for name, value in worker["labels"].items()),
        worker["version"],
        _time(worker["started_at"]),
        "" if beat_s is None else f"{beat_s:.0f} s ago",
    )


workers_app = command_group("They obey within two seconds; `ultragray worker` starts one.")
_workers = _Resource(
    workers_app,
    "workers",
    "worker",
    ("name", "state", "job", "host", "pid", "devices", "labels", "version", "started", "last sign"),
    _worker_row,
)
_workers.add_list("List the workers, also those that were lost within a day.", "ultragray workers list --json")


def _add_wish(wish: str, meaning: str) -> None:
    @workers_app.command(wish, help=meaning, epilog=examples(f"ultragray workers {wish} gpu-1"))
    @with_connection
    def command(
        connection: Connection,
        name: Annotated[str, argument("Name of the worker.", shown=False)],
        json: Json = False,
    ) -> None:
        worker = connection.json("POST", route("workers", name, suffix=f":{wish}"))
        at_hand = f", at the job {worker['job']}" if worker["job"] else ""
        tell(f"{worker['name']} {worker['state']}{at_hand}", worker, as_json=json)


_add_wish("pause", "Let a worker take no more jobs; it ends the one at hand. Holds until resume, restarts included.")
_add_wish(
    "drain", "As pause, but a training at hand goes back into the queue at once, and on elsewhere from its checkpoint."
)
_add_wish("resume", "Let a worker take jobs again.")
