"""The render pool: worker processes that turn poses into encoded frames. Free of torch."""

from .pool import PoolConfig, PoolStatistics, RenderPool
from .scenes import SceneStore
from .types import Encoding, Priority, RenderRequest, RenderResult

__all__ = [
    "Encoding",
    "PoolConfig",
    "PoolStatistics",
    "Priority",
    "RenderPool",
    "RenderRequest",
    "RenderResult",
    "SceneStore",
]
