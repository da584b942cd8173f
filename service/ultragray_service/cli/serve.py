"""`ultragray serve`: the settings of the command line, and a folder that has something to serve."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from ultragray.errors import InvalidArgument
from ultragray.phantom.demo import copy_demo_scene
from ultragray.scene.info import read_header
from ultragray_service.cli.options import FieldsOf, with_options
from ultragray_service.cli.terminal import argument, single
from ultragray_service.listening import check_port_is_free
from ultragray_service.settings import ENVIRONMENT_PREFIX, Settings, load_settings
from ultragray_workers.scenes import SUFFIX, SceneStore

DEMO_NAME = "demo"


@single(
    "ultragray serve  # the scenes of ./data; the demo scene where there are none",
    "ultragray serve liver.ugr spine.ugr --http-port 8080",
    "ultragray keys create alice --role admin > alice.key",
    "ultragray serve --host 0.0.0.0 --tls-certificate tls.crt --tls-key tls.key",
)
@with_options
def serve(
    scenes: Annotated[
        list[Path] | None, argument("Scene files to serve alone, without those of a data folder.")
    ] = None,
    *,
    options: Annotated[
        dict[str, Any],
        FieldsOf(
            Settings,
            *("data_folder", "artifact_folder", "host", "insecure", "http_port", "grpc_port", "igtl_port"),
            *("tls_certificate", "tls_key", "tls_client_ca"),
            *("processes", "threads_per_process", "backend", "log_format", "log_level"),
            environment=ENVIRONMENT_PREFIX,
        ),
    ],
) -> None:
    """It runs in the foreground until Ctrl-C or SIGTERM, and then ends what it has begun.

    Every other setting has an environment variable: ULTRAGRAY_ and its name.
    """
    serve_scenes(scenes or [], options)


def serve_scenes(scenes: Iterable[Path], options: Mapping[str, Any]) -> None:
    """Serve the given scene files, or the data folder of the settings, until the service has stopped.

    Given files are served by their stem from a folder of links. It lasts as long as the service, and so do its
    datasets and jobs, unless the settings name an artifact folder. A data folder without a scene gets the demo
    scene; the default one is made.
    Raises InvalidArgument, SceneFileInvalid, StartupFailed and OSError.
    """
    files = list(scenes)
    if not files:
        settings = load_settings(**options)
        folder = settings.data_folder
        for field, what in (("http_port", "HTTP"), ("grpc_port", "gRPC")):  # before a file is written
            check_port_is_free(settings.host, getattr(settings, field), what, field)
        if isinstance(folder, Path):
            if folder == Settings().data_folder:
                folder.mkdir(exist_ok=True)  # any other folder must exist: its name may be mistyped
            ensure_scenes(folder)
        _run(settings)
        return
    if "data_folder" in options:
        raise InvalidArgument("scenes and --data-folder cannot be given together", field="data_folder")
    with tempfile.TemporaryDirectory(prefix="ultragray-scenes-", ignore_cleanup_errors=True) as links:
        link_scenes(files, Path(links))
        settings = load_settings(**{**options, "data_folder": Path(links)})
        if settings.artifact_folder is None:
            if settings.database_url is not None:
                raise InvalidArgument(
                    "scenes served alone share no queue: add --artifact-folder, or unset ULTRAGRAY_DATABASE_URL",
                    field="artifact_folder",
                )
            typer.echo("Datasets and jobs end with this service; --artifact-folder keeps them", err=True)
        _run(settings)


def _run(settings: Settings) -> None:
    from ultragray_service.server import (
        run,  # imports all that a service needs, which takes long: mistakes are told before
    )

    run(settings)


def ensure_scenes(folder: Path) -> None:
    """Put the demo scene into a data folder without scenes, and say so. Raises InvalidArgument for no such folder."""
    if not folder.is_dir():
        raise InvalidArgument(f"data_folder must be an existing folder, got {str(folder)!r}", field="data_folder")
    if SceneStore(folder).names():
        return
    path = folder / f"{DEMO_NAME}{SUFFIX}"
    copy_demo_scene(path)
    info = read_header(path).info
    typer.echo(
        f"{folder} holds no scenes: wrote {path}: {info.dataset_name}, {info.gaussian_count:,} Gaussians", err=True
    )


def link_scenes(files: Iterable[Path], folder: Path) -> None:
    for file in files:
        read_header(file)
        link = folder / f"{file.stem}{SUFFIX}"
        if link.is_symlink():
            raise InvalidArgument(f"scenes must have different names, {file.stem!r} comes twice", field="scenes")
        link.symlink_to(file.resolve())
        if file.stem not in SceneStore(folder).names():
            raise InvalidArgument(
                f"scenes are served by name, at most 128 letters, digits, '.', '_', '-'; got {file.stem!r}",
                field="scenes",
            )
