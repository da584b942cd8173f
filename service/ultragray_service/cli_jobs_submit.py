"""`ultragray jobs submit train | render`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from ultragray.errors import InvalidArgument

from .cli_jobs_options import ApiKey, Priority, RequestId, Server, Wait

submit_app = typer.Typer(no_args_is_help=True, help="Put a job into the queue; its id is printed.")


@submit_app.command()
def train(
    dataset: Annotated[str, typer.Argument(help="Name of an uploaded dataset.", show_default=False)],
    scene: Annotated[str, typer.Option(help="Name that the scene will be served under.", show_default=False)],
    preset: Annotated[str, typer.Option(help="fast, or paper: the released recipe.")] = "fast",
    setting: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="NAME=VALUE", help="Any training setting; repeat.", show_default=False),
    ] = None,
    device: Annotated[str, typer.Option(help="auto, cpu, cuda or cuda:N.")] = "auto",
    request_id: RequestId = None,
    priority: Priority = 0,
    wait: Wait = False,
    server: Server = "http://127.0.0.1:8000",
    api_key: ApiKey = None,
) -> None:
    """Train a scene, which is served as soon as it is finished."""
    from .cli_train import parse_settings

    specification = {
        "dataset": dataset,
        "scene": scene,
        "preset": preset,
        "settings": parse_settings(setting) if setting else {},
        "device": device,
    }
    _submit("train", specification, request_id, priority, wait, server, api_key)


@submit_app.command()
def render(
    scene: Annotated[str, typer.Argument(help="Name of a scene of the service.", show_default=False)],
    poses: Annotated[
        Path | None,
        typer.Option(help="Poses in mm: .npy or .json, [P, 4, 4] or [P, 3, 4].", show_default="the training poses"),
    ] = None,
    jitter: Annotated[
        int | None,
        typer.Option(metavar="COUNT", help="So many poses about the training poses instead.", show_default=False),
    ] = None,
    translation_mm: Annotated[float, typer.Option(help="Of --jitter, along each axis.")] = 2.0,
    rotation_deg: Annotated[float, typer.Option(help="Of --jitter, about each axis.")] = 5.0,
    seed: Annotated[int, typer.Option(help="Of --jitter.")] = 0,
    height: Annotated[int | None, typer.Option(help="Depth samples.", show_default="as trained, else 512")] = None,
    width: Annotated[int | None, typer.Option(help="Scan lines.", show_default="as trained, else 512")] = None,
    outputs: Annotated[str, typer.Option(help="Some of bmode, echo, transmittance, coverage, with commas.")] = "bmode",
    format: Annotated[str, typer.Option(help="npz, or tar of PNGs and JSON (WebDataset).")] = "npz",
    request_id: RequestId = None,
    priority: Priority = 0,
    wait: Wait = False,
    server: Server = "http://127.0.0.1:8000",
    api_key: ApiKey = None,
) -> None:
    """Render many poses into one archive."""
    specification: dict[str, Any] = {
        "scene": scene,
        "height": height,
        "width": width,
        "outputs": [name.strip() for name in outputs.split(",") if name.strip()],
        "format": format,
    }
    if poses is not None and jitter is not None:
        raise InvalidArgument("--poses and --jitter cannot be given together", field="poses")
    if poses is not None:
        from ultragray.pose_file import load_poses

        specification["poses"] = load_poses(poses).tolist()
    elif jitter is not None:
        specification["sampler"] = {
            "kind": "jitter",
            "count": jitter,
            "translation_mm": translation_mm,
            "rotation_deg": rotation_deg,
            "seed": seed,
        }
    else:
        specification["sampler"] = {"kind": "training"}
    _submit("render", specification, request_id, priority, wait, server, api_key)


def _submit(
    kind: str,
    specification: dict[str, Any],
    request_id: str | None,
    priority: int,
    wait: bool,
    server: str,
    api_key: str | None,
) -> None:
    from .cli_jobs_watch import follow
    from .job_client import JobClient

    client = JobClient(server, api_key)
    body = {"kind": kind, "specification": specification, "request_id": request_id, "priority": priority}
    job, _ = client.submit(body)
    typer.echo(job["id"])
    if wait:
        follow(client, job["id"])
