import numpy as np
import numpy.typing as npt

_Floats = npt.NDArray[np.float32]

class PreparedScene:
    def __init__(
        self,
        means: _Floats,
        scales: _Floats,
        quats: _Floats,
        transmittances: _Floats,
        sh0: _Floats,
        shn: _Floats,
        sh_degree: int,
        sigmoid: bool,
    ) -> None: ...
    @property
    def bytes(self) -> int: ...

def render(
    scene: PreparedScene,
    convex: bool,
    width_cm: float,
    opening_rad: float,
    near_cm: float,
    far_cm: float,
    cull_far_cm: float,
    poses: npt.NDArray[np.float64],
    height: int,
    width: int,
    threads: int,
    instruction_set: str,
    bmode: _Floats | None,
    echo: _Floats | None,
    transmittance: _Floats | None,
    coverage: _Floats | None,
) -> None: ...
def instruction_sets() -> list[str]: ...
