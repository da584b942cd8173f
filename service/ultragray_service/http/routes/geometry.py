"""Probes and registrations: where image planes and robots are."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from fastapi import APIRouter, Path, Query
from starlette.requests import Request

from ultragray.contract import described, from_dict, to_dict
from ultragray.geometry.probe import Probe
from ultragray.geometry.registration import Registration
from ultragray_service.core.registrations import NamedRegistration, RegistrationPage
from ultragray_service.core.scenes import DEFAULT_PAGE_SIZE, MAX_PAGE_SIZE
from ultragray_service.http.bodies import RegistrationBody, body_schema, read_json_body
from ultragray_service.http.dependencies import PageToken, ServiceDep, problems

router = APIRouter(prefix="/v1/probes", tags=["probes"])

_LINES = 65


@dataclass(frozen=True)
class ImagePlane:
    """The image plane of a probe, told by its scan lines: x lateral, z axial, mm."""

    face_depth_mm: float = described("Depth of the face, from which a scanner counts.")
    pivot_depth_mm: float = described(
        "Where the middle of the face lies on the axial axis: a probe is turned about it."
    )
    lines_mm: list[tuple[float, float, float, float]] = described(
        "From the left edge of the image to its right one, at even distances: x and z where the image begins, x and z "
        "where it ends."
    )


@router.post(":plane", openapi_extra=body_schema(Probe), responses=problems(401, 413, 415, 422))
async def probe_plane(request: Request) -> ImagePlane:
    """Where the scan lines of a probe run: enough to draw its image, in the plane or in space, whatever its kind."""
    probe = await read_json_body(request, Probe)
    rows, columns = np.broadcast_arrays([0.0, 1.0], np.linspace(0.0, 1.0, _LINES)[:, None])
    ends = probe.points_mm(rows, columns)[..., [0, 2]]  # [_LINES, 2, 2]: line, near or far, x and z
    lines_mm = [(x0, z0, x1, z1) for x0, z0, x1, z1 in ends.reshape(_LINES, 4).round(6).tolist()]
    return ImagePlane(probe.face_depth_mm, probe.pivot_depth_mm, lines_mm)


registrations_router = APIRouter(prefix="/v1/registrations", tags=["registrations"])

Name = Annotated[str, Path(description="Name of the registration.", examples=["robot"])]
PageSize = Annotated[int, Query(ge=1, le=MAX_PAGE_SIZE, description="Registrations on one page.")]


@registrations_router.get("", responses=problems(401, 422, 503))
async def list_registrations(
    service: ServiceDep, page_size: PageSize = DEFAULT_PAGE_SIZE, page_token: PageToken = ""
) -> RegistrationPage:
    """The registrations that the key may see, by name.

    One that was put while its scene was private is seen by the owner of that scene and by admins alone; any other by
    who put it, and by all who see its scene.
    """
    return await service.registrations.page(page_size, page_token)


@registrations_router.get("/{registration}", responses=problems(401, 404, 422, 503))
async def get_registration(service: ServiceDep, registration: Name) -> NamedRegistration:
    """One registration."""
    return await service.registrations.get(registration)


@registrations_router.put(
    "/{registration}",
    openapi_extra=body_schema(RegistrationBody),
    responses=problems(401, 403, 404, 413, 415, 422, 429, 503),
)
async def put_registration(request: Request, service: ServiceDep, registration: Name) -> NamedRegistration:
    """Keeps a registration, in place of one of that name which is the key's own."""
    service.life.require_serving()
    body = await read_json_body(request, RegistrationBody)
    content = {name: value for name, value in to_dict(body).items() if name != "scene"}
    return await service.registrations.put(registration, body.scene, from_dict(Registration, content))


@registrations_router.delete("/{registration}", status_code=204, responses=problems(401, 403, 404, 422, 503))
async def delete_registration(service: ServiceDep, registration: Name) -> None:
    """Forgets a registration."""
    service.life.require_serving()
    await service.registrations.delete(registration)
