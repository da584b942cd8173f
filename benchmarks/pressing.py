"""Tissue that gives way to a face, beside finite elements; interfaces in frames, and the cost: `make pressing`.

A quarter of a block of layers under half the face, of bricks with quadratic displacements (scikit-fem): finer where the
face ends, fixed or free to sink into below, and free at its sides.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.sparse.linalg import splu
from skfem import Basis, BilinearForm, ElementHex0, ElementHex2, ElementVector, MeshHex, condense, solve
from skfem.helpers import ddot, sym_grad, trace
from skfem.models.elasticity import lame_parameters

from measuring import Document, Lines, columns, measure_runs
from ultragray import _cpu
from ultragray.geometry.probe import FloatArray, LinearProbe
from ultragray.phantom.demo import demo_poses, load_demo_scene
from ultragray.rendering.frames import Frames, render
from ultragray.rendering.settings import Contact
from ultragray.scene.gaussians import GaussianScene
from ultragray.scene.info import SceneInfo

PROBE = LinearProbe(width_mm=40.0, near_mm=0.0, far_mm=60.0)
FACE_MM = (40.0, 10.0)  # lateral, elevation
POISSON = 0.49  # of model/kernels/pressing.hpp
NAMES = {1: "fat", 2: "muscle", 3: "bone"}
Layers = Mapping[float, int]  # label by the depth at which its layer ends, mm
CASES: dict[str, Layers] = {
    "muscle": {150.0: 2},
    "fat over muscle": {8.0: 1, 150.0: 2},
    "muscle over fat": {8.0: 2, 150.0: 1},
    "fat over muscle over bone at 40 mm": {8.0: 1, 40.0: 2, 150.0: 3},
    "fat over muscle over bone at 23 mm": {8.0: 1, 23.0: 2, 150.0: 3},
}
INDENTATION_MM = 1.0
DEPTHS_MM, LATERAL_MM = np.array([0.5, 2, 4, 6, 8, 11, 15, 20, 26, 33, 39]), (0.0, 8.0, 15.0)
WALLS_MM = {"x": (0, 12, 17.5, 20, 24, 34, 60, 130), "y": (0, 3.5, 5, 9, 20, 45, 130)}
FLOORS_MM = (0, 3, 8, 14, 23, 40, 65, 150)
GAUSSIANS, ROUNDS, SIDE = 100_000, 200, 256
INTERFACE_MM, PRESSED_MM = 18.0, (2.0, 4.0)


def finite_elements(layers: Layers, indentation_mm: float = INDENTATION_MM) -> tuple[Callable[..., FloatArray], float]:
    """Displacement at points [3, N] -> [3, N], mm, and the force in N. Bone is the fixed floor."""
    floors = np.array([z for z in FLOORS_MM if all(label != 3 or z <= end for end, label in shifted(layers))])
    mesh = MeshHex.init_tensor(*(np.array(WALLS_MM[axis], float) for axis in "xy"), floors.astype(float))
    basis = Basis(mesh, ElementVector(ElementHex2()), intorder=4)
    of_elements = basis.with_element(ElementHex0())
    depth = mesh.p[2, mesh.t].mean(axis=0)
    young = np.array([_cpu.stiffness_kpa(NAMES[label_at(layers, z)]) for z in depth])
    lame, shear = (of_elements.interpolate(values) for values in lame_parameters(young, POISSON))

    @BilinearForm
    def energy(u: Any, v: Any, w: Any) -> Any:
        return w.lame * trace(sym_grad(u)) * trace(sym_grad(v)) + 2.0 * w.shear * ddot(sym_grad(u), sym_grad(v))

    stiffness = energy.assemble(basis, lame=lame, shear=shear)
    axis = np.zeros(basis.N, int)
    for d in range(3):
        for dofs in (basis.nodal_dofs, basis.edge_dofs, basis.facet_dofs, basis.interior_dofs):
            axis[dofs[d]] = d
    x, y, z = basis.doflocs
    face = (z == 0) & (x <= FACE_MM[0] / 2) & (y <= FACE_MM[1] / 2) & (axis == 2)
    is_fixed = face | (z == floors[-1]) | ((x == 0) & (axis == 0)) | ((y == 0) & (axis == 1))
    shifts_mm = np.where(face, indentation_mm, 0.0)

    def solved(matrix: Any, right: FloatArray) -> FloatArray:
        solution: FloatArray = splu(matrix.tocsc(), "MMD_AT_PLUS_A", 0.0, options={"SymmetricMode": True}).solve(right)
        return solution

    moved = solve(*condense(stiffness, basis.zeros(), x=shifts_mm, D=np.flatnonzero(is_fixed)), solver=solved)
    return basis.interpolator(moved), 4e-3 * float((stiffness @ moved)[face].sum())


def shifted(layers: Layers) -> list[tuple[float, int]]:
    """Where each layer begins, and its label."""
    return list(zip([0.0, *layers][:-1], layers.values(), strict=True))


def label_at(layers: Layers, depth_mm: float) -> int:
    return next(label for end, label in layers.items() if depth_mm < end)


def layered_scene(layers: Layers, count: int = 20_000, interface_mm: float | None = None) -> GaussianScene:
    """Labelled Gaussians at random in flat layers, swept from above; with a bright interface if one is wanted."""
    random = np.random.default_rng(0)
    means = random.uniform((-60.0, -30.0, 0.2), (60.0, 30.0, 75.0), (count, 3))
    labels = np.array([label_at(layers, z) for z in means[:, 2]])
    scales, echo = np.full((count, 3), -2.3), np.full(count, -1.7)
    if interface_mm is not None:
        plate = random.uniform((-30.0, -10.0), (30.0, 10.0), (6_000, 2))
        means = np.concatenate([means, np.column_stack([plate, np.full(len(plate), interface_mm)])])
        labels = np.append(labels, np.full(len(plate), label_at(layers, interface_mm)))
        scales = np.concatenate([scales, np.tile([-2.0, -2.0, -4.0], (len(plate), 1))])
        echo = np.append(echo, np.full(len(plate), 1.5))
    splats = {
        "means": means / 10.0,
        "scales": scales,
        "quats": np.tile([1.0, 0.0, 0.0, 0.0], (len(means), 1)),
        "transmittances": np.full(len(means), 6.0),
        "sh0": echo[:, None, None],
    }
    tensors = {name: torch.from_numpy(values).float() for name, values in splats.items()}
    poses = np.tile(np.eye(4), (9, 1, 1))
    poses[:, 1, 3] = np.linspace(-10.0, 10.0, 9)
    info = SceneInfo(probe=PROBE, label_names={label: NAMES[label] for label in sorted({*labels.tolist()})})
    return GaussianScene.from_splats(
        tensors, info=info, labels=torch.from_numpy(labels.astype(np.uint8)), training_poses=poses
    )


def pressed(scene: GaussianScene, indentation_mm: float, **options: Any) -> Frames:
    pose = np.eye(4)
    pose[2, 3] = indentation_mm
    size = {"height": SIDE, "width": SIDE, "outputs": ("echo",)}
    return render(scene, None, pose, **{**size, **options}, contact=Contact.PRESSURE)


def displaced_mm(frames: Frames, points: FloatArray) -> FloatArray:  # [N, 3] -> [N, 3]
    assert frames.pressing is not None
    assert frames.pressing.displacement is not None
    shifts_mm: FloatArray = frames.pressing.displacement.at(torch.from_numpy(points))[0].numpy()
    return shifts_mm


def beside_finite_elements(layers: Layers) -> Document:
    """Displacement under the face and force, ours and of finite elements."""
    true, force_n = finite_elements(layers)
    frames = pressed(layered_scene(layers), INDENTATION_MM)
    bottom = min([begins for begins, label in shifted(layers) if label == 3], default=np.inf)
    depths = DEPTHS_MM[bottom > DEPTHS_MM]
    points = np.array([(x, 0.0, z) for x in LATERAL_MM for z in depths])
    errors = displaced_mm(frames, points) - np.asarray(true(points.T)).reshape(3, -1).T
    assert frames.pressing is not None
    return {
        "worst": float(np.abs(errors[:, 2]).max() / INDENTATION_MM),
        "rms": float(np.sqrt(np.square(errors[:, 2]).mean()) / INDENTATION_MM),
        "worst_lateral": float(np.abs(errors[:, 0]).max() / INDENTATION_MM),
        "force_n": float(frames.pressing.force_n[0]),
        "true_force_n": force_n,
    }


def interface_depths(layers: Layers, indentation_mm: float) -> tuple[float, float]:
    """Depth of an interface under the middle of the face: in the frame, and as finite elements have it, mm."""
    scene = layered_scene(layers, interface_mm=INTERFACE_MM)
    echo = pressed(scene, indentation_mm)["echo"][0].double().numpy()
    column = echo[:, SIDE // 2 - 4 : SIDE // 2 + 4].mean(axis=1)
    rows = np.arange(SIDE)
    near = np.abs(rows - column.argmax()) <= 4
    seen = float((rows[near] * column[near]).sum() / column[near].sum() + 0.5) * PROBE.far_mm / SIDE
    true, _ = finite_elements(layers, indentation_mm)
    moved = np.asarray(true(np.array([[0.0], [0.0], [INTERFACE_MM]]))).reshape(3)
    return seen, INTERFACE_MM + float(moved[2]) - indentation_mm


def against_finite_elements(_: Path) -> Document:
    rows = [{"layers": name, **beside_finite_elements(layers)} for name, layers in CASES.items()]
    interfaces = []
    for name in ("fat over muscle", "fat over muscle over bone at 40 mm"):
        for indentation in PRESSED_MM:
            seen, true = interface_depths(CASES[name], indentation)
            interfaces.append({"layers": name, "indentation_mm": indentation, "seen_mm": seen, "true_mm": true})
    return {"rows": rows, "interfaces": interfaces}


def cost(_: Path) -> Document:
    """Milliseconds of a frame on two threads, with contact judged, and pressed in."""
    torch.set_num_threads(2)
    demo = load_demo_scene()
    random = np.random.default_rng(0)
    chosen = np.concatenate(
        [np.arange(len(demo.means)), random.integers(0, len(demo.means), GAUSSIANS - len(demo.means))]
    )
    splats = {name: tensor[chosen] for name, tensor in demo.splats.items()}
    labels = demo.labels
    assert labels is not None
    scene = replace(demo, **splats, labels=labels[chosen], info=replace(demo.info, gaussian_count=len(chosen)))
    pose = demo_poses(3)[1]
    pose[2, 3] = 4.0
    took: dict[Contact, list[float]] = {contact: [] for contact in Contact}
    with torch.no_grad():
        for _ in range(ROUNDS):
            for contact, times in took.items():
                began = time.perf_counter()
                render(scene, None, pose, height=SIDE, width=SIDE, outputs=("bmode",), contact=contact)
                times.append(1e3 * (time.perf_counter() - began))
    air, pressure = (float(np.median(took[contact])) for contact in (Contact.AIR, Contact.PRESSURE))
    return {"gaussians": len(scene.means), "air_ms": air, "pressure_ms": pressure}


def displacements(runs: Document) -> Lines:
    figures = runs["finite elements"]
    yield from columns(
        figures["rows"],
        {
            "Layers": "{layers}",
            "Largest error under the face": "{worst:.1%}",
            "rms": "{rms:.1%}",
            "Largest error sideways": "{worst_lateral:.1%}",
            "Force, N/mm": "{force_n:.2f}",
            "of finite elements": "{true_force_n:.2f}",
        },
    )
    yield ""
    yield from columns(
        figures["interfaces"],
        {
            f"Interface at {INTERFACE_MM:g} mm in": "{layers}",
            "Pressed in by, mm": "{indentation_mm:g}",
            "Its depth in the frame, mm": "{seen_mm:.2f}",
            "by finite elements": "{true_mm:.2f}",
        },
    )


def cost_of_pressing(runs: Document) -> Lines:
    yield (
        "A frame of {gaussians:,} Gaussians on two threads takes {air_ms:.2f} ms with contact judged, and "
        "{pressure_ms:.2f} ms pressed in."
    ).format_map(runs["cost"])


RUNS = {"finite elements": against_finite_elements, "cost": cost}

if __name__ == "__main__":
    measure_runs("pressing", __doc__, RUNS, threads=2)
