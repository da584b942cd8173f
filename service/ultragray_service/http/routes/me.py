"""Who asks."""

from __future__ import annotations

from fastapi import APIRouter

from ...access.principal import Me, me
from ..deps import ServiceDep, problems

router = APIRouter(prefix="/v1/me", tags=["access"])


@router.get("", responses=problems(401))
async def who_am_i(service: ServiceDep) -> Me:
    """The name and the role that the key stands for."""
    return me(service.guard.asks)
