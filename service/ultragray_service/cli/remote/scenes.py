"""`ultragray scenes …`: the scenes that a running service renders, and frames of them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ultragray.rendering.settings import FrameSettings, RenderSettings
from ultragray.samplers import Sampler
from ultragray.scene.info import read_header
from ultragray_service.cli.options import FieldsOf, poses_option, with_options
from ultragray_service.cli.remote.connection import with_connection
from ultragray_service.cli.remote.rendering import SUFFIXES, Wanted, checked_kind
from ultragray_service.cli.scenes import print_facts
from ultragray_service.cli.terminal import (
    SCENE_SUFFIX,
    Force,
    Json,
    check_file,
    command_group,
    examples,
    frames_in_words,
    output_option,
    print_table,
    tell,
    to_json,
    transferred,
)

if TYPE_CHECKING:
    from ultragray_service.remote.connection import Connection

command_app = command_group("The service renders them for clients; `ultragray render` does without a service.")
SceneName = Annotated[str, typer.Argument(metavar="NAME", help="Name of the scene.", show_default=False)]
_COLUMNS = ("name", "Gaussians", "image", "MB", "loaded", "owner", "error")


@command_app.command("list", epilog=examples("ultragray scenes list", "ultragray scenes list --json | jq '.[].name'"))
@with_connection
def list_scenes(connection: Connection, json: Json = False) -> None:
    """List the scenes by name."""
    from ultragray_service.remote.scenes import Scenes

    found = Scenes(connection).all()
    if json:
        typer.echo(to_json(found))
    else:
        print_table(_COLUMNS, map(_row, found))


@command_app.command(epilog=examples("ultragray scenes show demo", "ultragray scenes show demo --json | jq .probe"))
@with_connection
def show(connection: Connection, name: SceneName, json: Json = False) -> None:
    """Print probe, place, training poses and metrics of a scene; mm, in the frame of the training sweep."""
    from ultragray_service.remote.scenes import Scenes

    found = Scenes(connection).get(name)
    if json:
        typer.echo(to_json(found))
    else:
        print_facts(found)


@command_app.command(epilog=examples("ultragray scenes upload liver.ugr", "ultragray scenes upload a.ugr --name liver"))
@with_connection
def upload(
    connection: Connection,
    file: Annotated[Path, typer.Argument(help="Scene file (.ugr).", show_default=False)],
    name: Annotated[str | None, typer.Option(help="Name of the scene.", show_default="that of the file")] = None,
    private: Annotated[bool, typer.Option("--private", help="Others do not see it.")] = False,
    json: Json = False,
) -> None:
    """Have the service take a scene file in and render it."""
    from ultragray_service.remote.scenes import Scenes

    size = read_header(file).file_bytes
    called = file.stem if name is None else name
    with transferred(f"uploading {called}") as begin:
        scene = Scenes(connection).upload(called, file, begin(size), private=private)
    tell(f"uploaded {called}: {scene['gaussian_count']:,} Gaussians", scene, as_json=json)


@command_app.command(epilog=examples("ultragray scenes download demo -o demo.ugr"))
@with_connection
def download(
    connection: Connection,
    name: SceneName,
    output: Annotated[Path | None, output_option("Scene file to write (.ugr).", default="NAME.ugr, here")] = None,
    force: Force = False,
    json: Json = False,
) -> None:
    """Download a scene file."""
    from ultragray_service.remote.scenes import Scenes

    path = Path(f"{name}{SCENE_SUFFIX}") if output is None else output
    check_file(path, [SCENE_SUFFIX], force=force)
    with transferred(f"downloading {name}") as begin:
        size = Scenes(connection).download(name, path, begin)
    tell(f"wrote {path}: {size:,} bytes", {"output": str(path), "bytes": size}, as_json=json)


@command_app.command(epilog=examples("ultragray scenes delete liver"))
@with_connection
def delete(connection: Connection, name: SceneName, json: Json = False) -> None:
    """Delete a scene that was uploaded or trained there; scenes of the data folder stay."""
    from ultragray_service.remote.scenes import Scenes

    Scenes(connection).delete(name)
    tell(f"{name} deleted", {"deleted": name}, as_json=json)


@command_app.command(
    epilog=examples(
        "ultragray scenes render demo -o frame.png  # at the middle training pose",
        "ultragray scenes render demo -o frames.npz --poses path.npy --outputs bmode,echo",
        "ultragray scenes render demo -o frames.npz --poses flange.npy --registration robot",
        "ultragray scenes render demo -o pictures/ --sampler fan --tilt-deg 20 --step-deg 2",
    )
)
@with_options
@with_connection
def render(
    connection: Connection,
    name: SceneName,
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
    from ultragray_service.cli.remote.rendering import render_remotely

    suffix = checked_kind(output, settings, force=force)
    wanted = Wanted(name, output, suffix, poses, sampler, of_poses.get("registration"), settings)
    document = render_remotely(connection, wanted)
    size = f"{document['height']}x{document['width']}"
    tell(
        f"wrote {output}: {frames_in_words(document['frames'])} of {size}, {', '.join(settings.outputs)}",
        document,
        as_json=json,
    )


def _row(scene: dict[str, Any]) -> tuple[str, ...]:
    count, size, height = scene.get("gaussian_count"), scene.get("file_bytes"), scene.get("image_height")
    return (
        scene["name"],
        "" if count is None else f"{count:,}",
        "" if height is None else f"{scene['image_width']}x{height}",
        "" if size is None else f"{size / 1e6:,.1f}",
        "yes" if scene["loaded"] else "no",
        f"{scene.get('owner') or ''}{' (private)' if scene.get('private') else ''}",
        scene["error"]["detail"] if "error" in scene else "",
    )
