"""The extension module built from model/kernels; backends/cpu.py and training/steps/cpu_loss.py tell its arguments."""

from typing import Any

class PreparedScene:
    def __init__(
        self,
        means: Any,
        scales: Any,
        quats: Any,
        transmittances: Any,
        sh0: Any,
        shn: Any,
        sh_degree: int,
        sigmoid: bool,
        weighted: bool,
        sorted: bool,
        threads: int,
    ) -> None: ...
    @property
    def bytes(self) -> int: ...

class Recording:
    def __init__(self, scene: PreparedScene, **arguments: Any) -> None: ...
    def differentiate(self, **arguments: Any) -> None: ...

class GivenUp(Exception): ...

class TooCostly(Exception):
    args: tuple[int, int]  # pose, footprint pixels

def drawing_work(scene: PreparedScene, **arguments: Any) -> list[list[int]]: ...
def footprints(scene: PreparedScene, **arguments: Any) -> None: ...
def render(scene: PreparedScene, **arguments: Any) -> None: ...
def image_loss(x: Any, y: Any, gradient: Any, texture: float, threads: int, instruction_set: str) -> float: ...
def add_speckle(bmode: Any, out: Any, **arguments: Any) -> None: ...
def instruction_sets() -> list[str]: ...
