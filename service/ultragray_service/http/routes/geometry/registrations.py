"""Registrations of robots and trackers to scenes."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Path, Query
from starlette.requests import Request

from ultragray.contract import from_dict, to_dict
from ultragray.registration.registration import Registration
from ultragray_service.core.catalog import DEFAULT_PAGE_SIZE, MAX_PAGE_SIZE
from ultragray_service.http.deps import ServiceDep, problems
from ultragray_service.http.reading.bodies import RegistrationBody
from ultragray_service.http.reading.json_body import body_schema, read_json_body
from ultragray_service.registrations.named import NamedRegistration, RegistrationPage

router = APIRouter(prefix="/v1/registrations", tags=["registrations"])

Name = Annotated[str, Path(description="Name of the registration.", examples=["robot"])]
PageSize = Annotated[int, Query(ge=1, le=MAX_PAGE_SIZE, description="Registrations on one page.")]
PageToken = Annotated[str, Query(description="next_page_token of the page before.")]


@router.get("", responses=problems(401, 422, 503))
async def list_registrations(
    service: ServiceDep, page_size: PageSize = DEFAULT_PAGE_SIZE, page_token: PageToken = ""
) -> RegistrationPage:
    """The registrations that the key may see, by name.

    One that was put while its scene was private is seen by the owner of that scene and by admins alone; any other by
    who put it, and by all who see its scene.
    """
    return await service.registrations.page(page_size, page_token)


@router.get("/{registration}", responses=problems(401, 404, 422, 503))
async def get_registration(service: ServiceDep, registration: Name) -> NamedRegistration:
    """One registration."""
    return await service.registrations.get(registration)


@router.put(
    "/{registration}",
    openapi_extra=body_schema(RegistrationBody),
    responses=problems(401, 403, 404, 413, 415, 422, 429, 503),
)
async def put_registration(request: Request, service: ServiceDep, registration: Name) -> NamedRegistration:
    """Keeps a registration, in place of one of that name which is the key's own."""
    service.require_serving()
    body = await read_json_body(request, RegistrationBody)
    content = {name: value for name, value in to_dict(body).items() if name != "scene"}
    return await service.registrations.put(registration, body.scene, from_dict(Registration, content))


@router.delete("/{registration}", status_code=204, responses=problems(401, 403, 404, 422, 503))
async def delete_registration(service: ServiceDep, registration: Name) -> None:
    """Forgets a registration."""
    service.require_serving()
    await service.registrations.delete(registration)
