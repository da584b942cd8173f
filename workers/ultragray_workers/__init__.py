"""The render pool: worker processes that turn poses into encoded frames. Free of torch."""

from .pool.pool import PoolConfig, PoolStatistics, RenderPool
from .pool.types import Priority, RenderRequest, RenderResult
from .scenes import SceneStore

__all__ = [
    "PoolConfig",
    "PoolStatistics",
    "Priority",
    "RenderPool",
    "RenderRequest",
    "RenderResult",
    "SceneStore",
]
