"""Prometheus."""

from __future__ import annotations

from fastapi import APIRouter
from prometheus_client import CONTENT_TYPE_LATEST
from starlette.responses import Response

from ..deps import ServiceDep

router = APIRouter(tags=["metrics"])


@router.get(
    "/metrics",
    response_class=Response,
    responses={200: {"description": "The Prometheus text format.", "content": {"text/plain": {}}}},
)
async def metrics(service: ServiceDep) -> Response:
    """Requests, frames, queue, render and encode times, and the state of the render pool."""
    return Response(service.metrics.exposition(), media_type=CONTENT_TYPE_LATEST)
