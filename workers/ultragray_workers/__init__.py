"""The render pool: worker processes that turn poses into encoded frames. Free of torch.

The names are imported on first use: most of the package does without the pool.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ultragray_workers.pool.messages import PoolConfig, Priority, RenderRequest, RenderResult
    from ultragray_workers.pool.pool import PoolStatistics, RenderPool
    from ultragray_workers.scenes import SceneStore

__all__ = [
    "PoolConfig",
    "PoolStatistics",
    "Priority",
    "RenderPool",
    "RenderRequest",
    "RenderResult",
    "SceneStore",
]

_MODULES = {
    "pool.pool": ("PoolStatistics", "RenderPool"),
    "pool.messages": ("PoolConfig", "Priority", "RenderRequest", "RenderResult"),
    "scenes": ("SceneStore",),
}
_MODULE_OF = {name: module for module, names in _MODULES.items() for name in names}


def __getattr__(name: str) -> Any:
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f".{_MODULE_OF[name]}", __name__), name)
    globals()[name] = value
    return value
