"""`ultragray jobs submit train | render`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from .jobs_options import ApiKey, Priority, RequestId, Server, Wait
from .sampler import (
    Count,
    Kind,
    MinConfidence,
    RotationDeg,
    Seed,
    SpacingMm,
    StepDeg,
    TiltDeg,
    TranslationMm,
    sampler_document,
)

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
    from .train import parse_settings

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
    sampler: Kind = None,
    count: Count = None,
    translation_mm: TranslationMm = None,
    rotation_deg: RotationDeg = None,
    seed: Seed = None,
    spacing_mm: SpacingMm = None,
    tilt_deg: TiltDeg = None,
    step_deg: StepDeg = None,
    height: Annotated[int | None, typer.Option(help="Depth samples.", show_default="as trained, else 512")] = None,
    width: Annotated[int | None, typer.Option(help="Scan lines.", show_default="as trained, else 512")] = None,
    outputs: Annotated[
        str, typer.Option(help="Some of bmode, echo, transmittance, coverage, labels, with commas.")
    ] = "bmode",
    format: Annotated[str, typer.Option(help="npz, tar (WebDataset), zarr, hdf5, dicom, or plus (.igs.mha).")] = "npz",
    dtype: Annotated[str | None, typer.Option(help="uint8 or float32.", show_default="the format's own")] = None,
    min_confidence: MinConfidence = None,
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
        "dtype": dtype,
        "min_confidence": min_confidence,
        "sampler": sampler_document(
            sampler,
            count=count,
            translation_mm=translation_mm,
            rotation_deg=rotation_deg,
            seed=seed,
            spacing_mm=spacing_mm,
            tilt_deg=tilt_deg,
            step_deg=step_deg,
        ),
    }
    if poses is not None:
        from ultragray.files.poses import load_poses

        specification["poses"] = load_poses(poses).tolist()
    elif specification["sampler"] is None:
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
    from ..core.job_client import JobClient
    from .jobs_watch import follow

    client = JobClient(server, api_key)
    body = {"kind": kind, "specification": specification, "request_id": request_id, "priority": priority}
    job, _ = client.submit(body)
    typer.echo(job["id"])
    if wait:
        follow(client, job["id"])
