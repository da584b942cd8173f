"""What the service is, and where its other doors are."""

from __future__ import annotations

from fastapi import APIRouter

from ultragray_service.doors import ServiceInfo
from ultragray_service.http.deps import ServiceDep, problems

router = APIRouter(prefix="/v1/service", tags=["service"])


@router.get("", responses=problems(401))
async def get_service(service: ServiceDep) -> ServiceInfo:
    """Version, and the ports of gRPC and OpenIGTLink, for pages that tell how to connect."""
    return service.doors.info(key_required=service.guard.asks)
