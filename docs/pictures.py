"""Draws the pictures of the documents from the demo scene: `python docs/pictures.py`, into docs/images.

`python docs/pictures.py FOLDER` also takes the tutorial's pictures from the folder in which its commands were run.
The README's pictures come from `make demo-scene` and `make console-picture`.
"""

from __future__ import annotations

import json
import runpy
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import cv2
import matplotlib as mpl
import numpy as np
import numpy.typing as npt
import torch

mpl.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Polygon
from matplotlib.transforms import Affine2D
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from mcap_ros2.writer import Writer

from ultragray import GaussianScene, read_header, render
from ultragray.contract import to_dict
from ultragray.datasets.mcap import read_mcap_sweep
from ultragray.exchange import ros_messages as ros
from ultragray.exchange.rendering import render_to_file
from ultragray.geometry.pose import pose_from_position_quaternion
from ultragray.geometry.probe import LinearProbe
from ultragray.learn.editing.editor import edit_scene
from ultragray.learn.evaluation.baselines import compound
from ultragray.learn.motion import add_motion
from ultragray.learn.registration import register_frames
from ultragray.learn.training.agreement import agreed_path
from ultragray.phantom import PHANTOM_PROBE, freehand_poses, simulate
from ultragray.phantom.abdomen import ABDOMEN, ABDOMEN_PROBE
from ultragray.phantom.demo import DEMO_FILE
from ultragray.phantom.recipes import make_abdomen
from ultragray.rendering.display import Display
from ultragray.rendering.frames import render_shown, show
from ultragray.rendering.pixels import to_uint8
from ultragray.rendering.settings import Contact, Encoding, FrameSettings, Speckle
from ultragray.rendering.tools import DEFAULT_LABEL, Box, Cylinder, Needle, Tool, ToolFrame
from ultragray.rendering.volume_fields import sample_slice
from ultragray.rendering.volumes import VOLUME_FIELDS, VolumeGrid
from ultragray.samplers import AroundSampler
from ultragray.scene.confidence import Assessor, supported
from ultragray.scene.edits import InsertEdit
from ultragray.scene.motion_settings import MotionSettings
from ultragray.scene.shapes import SphereShape, TubeShape
from ultragray_studies.gym import UltragrayEnv
from ultragray_studies.hand import Errors, HandSweep

IMAGES = Path(__file__).resolve().parent / "images"
EXAMPLES = IMAGES.parents[1] / "examples"
Floats = npt.NDArray[np.float64]

SIDE = 256
EXTENT_MM = (-30.0, 30.0, 60.0, 0.0)  # of the demo scene's probe: left, right, bottom, top
OVER_CANAL_MM = 19.0  # along the spine: bone to both sides, the canal between them
PRESSED_MM = 6.0
MOST_AGENT_STEPS = 1000
_TO_PAPER = np.array([[1.0, 0.55, 0.0], [0.0, -0.4, 1.0]])  # cabinet projection: x to the right, z down, y away
LABEL_COLOURS = {"bone": "#f4d58d", "muscle": "#d1495b", "fat": "#edae49", "vessel": "#30a0e0", "tool": "#ffffff"}
LABEL_COLOURS |= {"cyst": "#5bc8af", "calcification": "#f26419", "artery": "#e84855", "artery wall": "#ffd6d6"}


def main() -> None:
    scene = GaussianScene.load(DEMO_FILE)
    draw_maps(scene, IMAGES / "maps.png")
    draw_display_settings(scene, IMAGES / "display_settings.png")
    draw_confidence(scene, IMAGES / "confidence_off_the_sweep.png")
    draw_augmentation(scene, IMAGES / "augmentation.png")
    draw_contact(scene, IMAGES / "contact.png")
    draw_pressing(scene, IMAGES / "pressing.png")
    draw_speckle(scene, IMAGES / "speckle.png")
    draw_tools(scene, IMAGES / "tools.png")
    draw_editing(scene, IMAGES / "editing.png")
    draw_abdomen(IMAGES / "abdomen.png")
    draw_motion(scene, IMAGES / "motion.png")
    draw_cases(scene, IMAGES / "cases.png")
    draw_standard_plane(scene, IMAGES / "standard_plane.png")
    draw_slices(scene, IMAGES / "volume_slices.png")
    draw_recording(scene, IMAGES / "mcap_recording.png")
    draw_recorded_sweep(scene, IMAGES / "mcap_sweep.png")
    draw_live_in_volume(scene, IMAGES / "slicer.png")
    draw_registration(scene, IMAGES / "registration.png")
    draw_hand(IMAGES / "hand.png")
    for folder in sys.argv[1:]:
        shrink(Path(folder) / "sweep.png", IMAGES / "tutorial_sweep.png", width=1000)
        shrink(Path(folder) / "pictures" / "frame_00007.png", IMAGES / "tutorial_eval.png", width=1000)


def along_spine(y_mm: float) -> Floats:  # [4, 4]
    """The pose of an upright transverse view at `y_mm` along the spine."""
    pose = np.eye(4)
    pose[1, 3] = y_mm
    return pose


def draw_maps(scene: GaussianScene, path: Path) -> None:
    """Every output of one view."""
    brightest = {"attenuation": 0.3, "uncertainty": 0.25}
    captions = {
        "bmode": "bmode: what a scanner shows",
        "echo": "echo: what tissue reflects",
        "transmittance": "transmittance: beam that is left",
        "attenuation": "attenuation: beam lost here",
        "coverage": "coverage: support by the scene",
        "uncertainty": "uncertainty: expected error",
        "labels": "labels: what lies here",
    }
    frames = render(scene, None, along_spine(OVER_CANAL_MM), height=SIDE, width=SIDE, outputs=tuple(captions))
    figure, panels = panel_row(rows=2, columns=4)
    for panel, (output, caption) in zip(panels, captions.items(), strict=False):
        if output == "labels":
            draw_labels(panel, frames[output][0].numpy(), scene.info.label_names)
        else:
            colours = "gray" if output in ("bmode", "echo") else "magma"
            values, top = frames[output][0].numpy(), brightest.get(output, 1.0)
            panel.imshow(values, cmap=colours, vmin=0.0, vmax=top, extent=EXTENT_MM)
        panel.set_title(caption, fontsize=8)
    panels[-1].axis("off")
    panels[-1].legend(
        handles=[Patch(color=LABEL_COLOURS[name], label=name) for name in scene.info.label_names.values()],
        title="labels",
        loc="center",
        frameon=False,
    )
    save(figure, path)


def draw_labels(panel: Axes, labels: npt.NDArray[np.uint8], names: dict[int, str]) -> None:  # [H, W]
    """Labels in their colours; black where there is none."""
    colours = np.zeros((256, 3))
    for number, name in names.items():
        colours[number] = mpl.colors.to_rgb(LABEL_COLOURS[name])
    panel.imshow(colours[labels], extent=EXTENT_MM, interpolation="nearest")


def draw_display_settings(scene: GaussianScene, path: Path) -> None:
    """One frame as a sonographer's settings show it."""
    settings = {
        "as rendered: gain 0 dB, range 60 dB": Display(),
        "gain +10 dB": Display(gain_db=10.0),
        "dynamic range 40 dB": Display(dynamic_range_db=40.0),
        "TGC: −12 dB at the skin … +12 dB deep": Display(tgc_db=(-12.0, 0.0, 12.0)),
        "depth 35 mm": Display(depth_mm=35.0),
        "edge enhancement 2": Display(edge=2.0),
    }
    probe = scene.info.probe_or(None)
    frames = render(scene, None, along_spine(OVER_CANAL_MM), height=SIDE, width=SIDE, outputs=("bmode",))
    figure, panels = panel_row(rows=2, columns=3)
    for panel, (caption, display) in zip(panels, settings.items(), strict=True):
        left, right, bottom, top = EXTENT_MM
        shown_mm = display.depth_mm or bottom
        image = show(frames, probe, display)["bmode"][0].numpy()
        panel.imshow(image, cmap="gray", vmin=0.0, vmax=1.0, extent=(left, right, shown_mm, top))
        panel.set_title(caption, fontsize=8)
    save(figure, path)


def draw_confidence(scene: GaussianScene, path: Path) -> None:
    """Frames that leave the sweep at its end, with what each says about itself."""
    places_mm = (36.0, 40.0, 44.0, 50.0, 60.0)
    poses = np.stack([along_spine(y) for y in places_mm])
    frames = render(scene, None, poses, height=SIDE, width=SIDE, outputs=("bmode", "coverage"))
    header = read_header(DEMO_FILE)
    told = Assessor(header.info, header.training_poses).assess(poses, coverage=frames["coverage"].numpy())
    figure, panels = panel_row(rows=1, columns=len(places_mm))
    for panel, image, one in zip(panels, frames["bmode"].numpy(), told, strict=True):
        panel.imshow(image, cmap="gray", vmin=0.0, vmax=1.0, extent=EXTENT_MM)
        panel.set_title(f"{one.distance_mm:.1f} mm away: confidence {one.confidence:.2f}", fontsize=8)
    save(figure, path)


def draw_augmentation(scene: GaussianScene, path: Path) -> None:
    """Views drawn around the training poses, and the labels that come with them where the scene supports a pixel."""
    probe = scene.info.probe_or(None)
    sampler = AroundSampler(count=6, translation_mm=4.0, rotation_deg=8.0, seed=3)
    poses = sampler.poses(scene.training_poses, probe)
    frames = render(scene, None, poses, height=SIDE, width=SIDE, outputs=("bmode", "labels", "coverage"))
    labels = np.where(supported(frames["coverage"].numpy()), frames["labels"].numpy(), 0)
    figure, panels = panel_row(rows=2, columns=len(poses))
    for number in range(len(poses)):
        panels[number].imshow(frames["bmode"][number].numpy(), cmap="gray", vmin=0.0, vmax=1.0, extent=EXTENT_MM)
        draw_labels(panels[number + len(poses)], labels[number], scene.info.label_names)
    save(figure, path)


def draw_contact(scene: GaussianScene, path: Path) -> None:
    """A probe on the skin, tilted, lifted and pressed in, with the share of contact of each frame."""
    poses = {"on the skin": along_spine(OVER_CANAL_MM)}
    poses["tilted by 10°"] = _tilted(poses["on the skin"], 10.0)
    for caption, lifted_mm in (("lifted by 2 mm", 2.0), ("lifted by 6 mm", 6.0), ("pressed in by 8 mm", -8.0)):
        poses[caption] = poses["on the skin"].copy()
        poses[caption][2, 3] -= lifted_mm
    stacked = np.stack(list(poses.values()))
    size = {"height": SIDE, "width": SIDE, "outputs": ("bmode",)}
    rows = [render(scene, None, stacked, **size, contact=contact) for contact in (None, Contact.PRESSURE)]
    figure, panels = panel_row(rows=2, columns=len(poses))
    for row, frames in enumerate(rows):
        for column, (caption, image) in enumerate(zip(poses, frames["bmode"].numpy(), strict=True)):
            panel = panels[row * len(poses) + column]
            panel.imshow(image, cmap="gray", vmin=0.0, vmax=1.0, extent=EXTENT_MM)
            told = caption if frames.touch is None else f"contact {frames.touch.shares[column]:.0%}"
            panel.set_title(told, fontsize=8)
    save(figure, path)


def draw_pressing(scene: GaussianScene, path: Path) -> None:
    """A frame on the skin and one pressed in, over a grid that lies in the tissue."""
    poses = np.stack([along_spine(OVER_CANAL_MM)] * 2)
    poses[1, 2, 3] += PRESSED_MM
    frames = render(scene, None, poses, height=SIDE, width=SIDE, outputs=("bmode",), contact=Contact.PRESSURE)
    assert frames.pressing is not None
    assert frames.pressing.displacement is not None
    x, z = np.linspace(-28.0, 28.0, 113), np.arange(5.0, 60.0, 5.0)
    rows = np.stack(np.broadcast_arrays(x, 0.0, z[:, None]), axis=-1)
    columns = np.stack(
        np.broadcast_arrays(np.arange(-25.0, 26.0, 5.0)[:, None], 0.0, np.linspace(0.0, 60.0, 121)), axis=-1
    )
    figure, panels = panel_row(rows=1, columns=2)
    for number, panel in enumerate(panels):
        panel.imshow(frames["bmode"][number].numpy(), cmap="gray", vmin=0.0, vmax=1.0, extent=EXTENT_MM)
        panel.set_autoscale_on(False)
        for line in (*rows, *columns):  # in the image plane of the first pose, which is that of the second
            in_scene = torch.from_numpy(line @ poses[0, :3, :3].T + poses[0, :3, 3])
            moved = in_scene + frames.pressing.displacement.at(in_scene, number)[0]
            seen = (moved.numpy() - poses[number, :3, 3]) @ poses[number, :3, :3]
            panel.plot(seen[:, 0], seen[:, 2], color="tab:cyan", linewidth=0.4, alpha=0.7)
        depth, force = frames.pressing.indentation_mm[number], frames.pressing.force_n[number]
        panel.set_title(f"pressed in by {depth:.1f} mm, {force:.1f} N", fontsize=8)
    save(figure, path)


def draw_speckle(scene: GaussianScene, path: Path) -> None:
    """A frame of a sweep that the scene was not trained from: true, rendered, and rendered with natural speckle."""
    pose = freehand_poses(24, tilt_deg=5.0, offset_mm=1.0, unrest=3.0)[9]
    true = simulate(pose[None], probe=PHANTOM_PROBE, height=SIDE, width=SIDE)[0] / 255.0
    asked: dict[str, Any] = {"height": SIDE, "width": SIDE, "outputs": ("bmode",)}
    frames = [render(scene, None, pose, **asked, speckle=one)["bmode"][0].numpy() for one in Speckle]
    figure, panels = panel_row(rows=1, columns=3)
    titles = ("true frame, held out", "rendered", "rendered, natural speckle")
    for panel, title, frame in zip(panels, titles, (true, *frames), strict=True):
        panel.imshow(frame, cmap="gray", vmin=0.0, vmax=1.0, interpolation="nearest")
        panel.set_title(title)
    figure.set_size_inches(10.0, 3.6)
    save(figure, path)


def draw_tools(scene: GaussianScene, path: Path) -> None:
    """Needles at angles, a rod, a plate, their labels, and the ghosts beyond an interface."""
    steep = Needle(tip_mm=(4.0, 0.0, 31.0), hub_mm=(-24.0, 0.0, 2.0), frame=ToolFrame.PROBE)
    flat = replace(steep, tip_mm=(8.0, 0.0, 20.0), hub_mm=(-30.0, 0.0, 14.0))
    opaque = replace(flat, diameter_mm=1.6, opacity=0.95, reverberation=0.6)
    rod = Cylinder(tip_mm=(2.0, -15.0, 22.0), hub_mm=(2.0, 15.0, 22.0), diameter_mm=6.0, frame=ToolFrame.PROBE)
    plate = Box(
        centre_mm=(-10.0, 0.0, 20.0),
        size_mm=(18.0, 10.0, 2.5),
        quaternion=(0.990, 0.0, 0.141, 0.0),
        frame=ToolFrame.PROBE,
    )
    shown: dict[str, tuple[tuple[Tool, ...], float]] = {
        "needle at 46°": ((steep,), 0.0),
        "needle at 9°": ((flat,), 0.0),
        "thick, opaque: comet tail": ((opaque,), 0.0),
        "cylinder across the plane": ((rod,), 0.0),
        "box, turned by 16°": ((plate,), 0.0),
        "ghost 0.5, no tool": ((), 0.5),
    }
    figure, panels = panel_row(rows=2, columns=len(shown))
    names = {**scene.info.label_names, DEFAULT_LABEL: "tool"}
    for number, (caption, (tools, ghost)) in enumerate(shown.items()):
        size = {"height": SIDE, "width": SIDE, "outputs": ("bmode", "labels")}
        frames = render(scene, None, along_spine(OVER_CANAL_MM), **size, tools=tools, ghost=ghost)
        panels[number].imshow(frames["bmode"][0].numpy(), cmap="gray", vmin=0.0, vmax=1.0, extent=EXTENT_MM)
        panels[number].set_title(caption, fontsize=8)
        draw_labels(panels[number + len(shown)], frames["labels"][0].numpy(), names)
    save(figure, path)


def draw_editing(scene: GaussianScene, path: Path) -> None:
    """What was recorded, and what edits put into it, with its labels."""
    cyst = InsertEdit(shape=SphereShape(centre_mm=(-14.0, 0.0, 24.0), radius_mm=5.0), tissue="cyst")
    stone = InsertEdit(shape=SphereShape(centre_mm=(15.0, 0.0, 20.0), radius_mm=1.5), tissue="calcification")
    way = TubeShape(points_mm=((-26.0, -4.0, 20.0), (-14.0, 0.0, 24.0), (-2.0, 4.0, 20.0)), radius_mm=2.2)
    vessel = InsertEdit(shape=way, tissue="blood", label="artery", wall_mm=0.6)
    edited = {
        "as recorded": scene,
        "a cyst, a calcification": edit_scene(scene, [cyst, stone]),
        "a vessel": edit_scene(scene, [vessel]),
    }
    figure, panels = panel_row(rows=2, columns=len(edited))
    for place, (title, one) in enumerate(edited.items()):
        frames = render(one, None, np.eye(4), height=SIDE, width=SIDE, outputs=("bmode", "labels", "coverage"))
        panels[place].imshow(frames["bmode"][0].numpy(), cmap="gray", vmin=0.0, vmax=1.0, extent=EXTENT_MM)
        panels[place].set_title(title, fontsize=8)
        labels = np.where(supported(frames["coverage"][0].numpy()), frames["labels"][0].numpy(), 0)
        draw_labels(panels[place + len(edited)], labels, one.info.label_names)
    save(figure, path)


def draw_abdomen(path: Path) -> None:
    """The second phantom as its simulation, the scene made from its labels, and the labels, at two places."""
    scene, size = make_abdomen(), {"height": 400, "width": 320}
    poses = np.stack([along_spine(y_mm) for y_mm in (-12.0, 16.0)])
    asked = FrameSettings(**size, speckle=Speckle.NATURAL, outputs=("bmode", "labels"))
    frames = render_shown(scene, asked.resolved(scene.info, Encoding.FLOAT32), poses)
    simulated = simulate(poses, probe=ABDOMEN_PROBE, **size, phantom=ABDOMEN)
    figure, panels = panel_row(rows=2, columns=3)
    extent = (-40.0, 40.0, 100.0, 0.0)
    for place in range(2):
        pictures = simulated[place] / 255.0, frames["bmode"][place].numpy(), frames["labels"][place].numpy()
        for column, (picture, caption) in enumerate(
            zip(pictures, ("simulation", "made from labels", "labels"), strict=True)
        ):
            panel = panels[3 * place + column]
            colours = "tab20" if caption == "labels" else "gray"
            panel.imshow(picture, cmap=colours, vmin=0, vmax=19 if caption == "labels" else 1.0, extent=extent)
            if place == 0:
                panel.set_title(caption, fontsize=8)
    save(figure, path)


def draw_motion(scene: GaussianScene, path: Path) -> None:
    """The built-in chest: deep tissue goes from the skin as it breathes."""
    moving = add_motion(scene, MotionSettings(chest_mm=8.0)).scene
    figure, panels = panel_row(rows=1, columns=3)
    phases = {"at rest": 0.0, "half a breath": 0.5, "full breath": 1.0}
    for panel, (title, number) in zip(panels, phases.items(), strict=True):
        frame = render(moving.at_phase((number,)), None, np.eye(4), height=SIDE, width=SIDE, outputs=("bmode",)).bmode
        panel.imshow(frame[0].numpy(), cmap="gray", vmin=0.0, vmax=1.0, extent=EXTENT_MM)
        panel.set_title(title, fontsize=8)
    save(figure, path)


def draw_cases(scene: GaussianScene, path: Path) -> None:
    """The cases of docs/howto/shadows.md: above B-mode, below the transmittance that tells what is a shadow."""
    needle = Needle(tip_mm=(14.0, OVER_CANAL_MM, 21.0), hub_mm=(-30.0, OVER_CANAL_MM, 9.0))
    tilted = pose_from_position_quaternion((-4.0, OVER_CANAL_MM, 0.0), (0.996917334, 0.0, -0.078459096, 0.0))
    cases: list[tuple[Floats, dict[str, Any]]] = [
        (along_spine(0.0), {}),
        (along_spine(30.0), {}),
        (along_spine(OVER_CANAL_MM), {}),
        (along_spine(OVER_CANAL_MM), {"tools": (needle,)}),
        (tilted, {"contact": Contact.AIR}),
        (along_spine(6.0), {"ghost": 0.8}),
    ]
    figure, panels = panel_row(rows=2, columns=len(cases))
    for number, (pose, more) in enumerate(cases):
        outputs = ("bmode", "transmittance")
        frames = render(scene, None, pose, height=SIDE, width=SIDE, outputs=outputs, **more)
        for row, output in enumerate(outputs):
            panel = panels[number + row * len(cases)]
            panel.imshow(frames[output][0].numpy(), cmap="gray", vmin=0.0, vmax=1.0, extent=EXTENT_MM)
        panels[number].set_title(str(number + 1))
    save(figure, path)


def draw_standard_plane(scene: GaussianScene, path: Path) -> None:
    """Frames of an episode of the agent in examples/, and the goal."""
    agent = runpy.run_path(str(EXAMPLES / "standard_plane.py"))["Climber"](np.random.default_rng(0))
    env = UltragrayEnv(scene, height=SIDE, width=SIDE, start_mm=6.0, start_deg=6.0)
    frame, told = env.reset(seed=3)
    seen, reward = [(0, frame, told)], -np.inf
    reached = False
    while not reached and len(seen) < MOST_AGENT_STEPS:
        frame, reward, reached, _, told = env.step(agent.act(reward))
        seen.append((len(seen), frame, told))
    best = np.maximum.accumulate([told["similarity"] for _, _, told in seen])
    wanted = np.linspace(best[0], best[-1], 4)
    shown = [seen[int(np.argmax(best >= level))] for level in wanted]
    figure, panels = panel_row(rows=1, columns=len(shown) + 1)
    for panel, (step, image, one) in zip(panels, shown, strict=False):
        panel.imshow(image, cmap="gray", vmin=0, vmax=255, extent=EXTENT_MM)
        caption = (
            f"step {step}: {one['distance_mm']:.1f} mm, {one['angle_deg']:.1f}°, similarity {one['similarity']:.2f}"
        )
        panel.set_title(caption, fontsize=7)
    goal = render(scene, None, env.goal, height=SIDE, width=SIDE, outputs=("bmode",))["bmode"][0].numpy()
    panels[-1].imshow(goal, cmap="gray", vmin=0.0, vmax=1.0, extent=EXTENT_MM)
    panels[-1].set_title("goal", fontsize=7)
    save(figure, path)


def _tilted(pose: Floats, angle_deg: float) -> Floats:  # [4, 4] -> [4, 4]
    """Turned about the elevation."""
    angle, turn = np.radians(angle_deg), np.eye(4)
    turn[:3, :3] = [[np.cos(angle), 0.0, -np.sin(angle)], [0.0, 1.0, 0.0], [np.sin(angle), 0.0, np.cos(angle)]]
    return pose @ turn


def draw_slices(scene: GaussianScene, path: Path) -> None:
    """The fields of a volume on one coronal plane, which no probe on the skin could show."""
    low, high = (np.array(bound) for bound in (scene.info.bounds_min_mm, scene.info.bounds_max_mm))
    middle = float(low[2] + 0.45 * (high[2] - low[2]))
    size = (high - low)[:2]
    grid = VolumeGrid.on_plane((low[0], low[1], middle), (1, 0, 0), (0, 1, 0), size, 0.25)
    extent = (low[0], high[0], high[1], low[1])
    figure, panels = panel_row(rows=1, columns=4)
    for panel, field in zip(panels, VOLUME_FIELDS, strict=True):
        values = sample_slice(scene, field, grid)
        if field == "labels":
            panel.imshow(np.zeros((*values.shape, 3)), extent=extent)
            for label, name in scene.info.label_names.items():
                mask = np.ma.masked_where(values != label, values)
                panel.imshow(mask, cmap=ListedColormap([LABEL_COLOURS[name]]), extent=extent)
        else:
            panel.imshow(values, cmap="gray", vmin=0, extent=extent)
        panel.set_title(field, fontsize=9)
    save(figure, path)


def draw_recording(scene: GaussianScene, path: Path) -> None:
    """An MCAP file as its own reader reads it: some images, and confidence and position over the time of the stamps."""
    poses = np.stack([along_spine(y) for y in np.linspace(0.0, 48.0, 97)])
    settings = FrameSettings(height=SIDE, width=SIDE).resolved(scene.info, Encoding.UINT8)
    told = Assessor(scene.info, scene.training_poses).assess(poses)
    heard: dict[str, list[Any]] = {}
    with tempfile.TemporaryDirectory() as folder:
        recording = Path(folder, "sweep.mcap")
        render_to_file(recording, "mcap", scene, settings, poses, told, scene_name="demo", scene_sha256="")
        with recording.open("rb") as file:
            for found in make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages():
                heard.setdefault(found.channel.topic.rpartition("/")[2], []).append(found.decoded_message)
    shown = heard["bmode"][::24]
    figure = plt.figure(figsize=(2.4 * len(shown), 4.2), layout="constrained")
    grid = figure.add_gridspec(2, len(shown), height_ratios=(3, 2))
    for column, image in enumerate(shown):
        panel = figure.add_subplot(grid[0, column], xticks=[], yticks=[])
        pixels = np.frombuffer(image.data, np.uint8).reshape(image.height, image.width)
        panel.imshow(pixels, cmap="gray", extent=EXTENT_MM)
        panel.set_title(f"/ultragray/bmode at {_seconds(image):.2f} s", fontsize=8)
    times_s = [_seconds(one) for one in heard["confidence"]]
    values = [{pair.key: float(pair.value) for pair in one.status[0].values} for one in heard["confidence"]]
    below = figure.add_subplot(grid[1, :], xlabel="time of the stamp, s", ylabel="confidence")
    below.plot(times_s, [one["confidence"] for one in values], color="#d1495b", label="/ultragray/confidence")
    beside = below.twinx()
    beside.plot(times_s, [one.pose.position.y for one in heard["probe_pose"]], color="#30a0e0")
    beside.set_ylabel("y of the probe, m")
    below.plot([], [], color="#30a0e0", label="/ultragray/probe_pose")  # both curves in one legend
    below.legend(loc="center left", fontsize=8)
    save(figure, path)


def draw_recorded_sweep(scene: GaussianScene, path: Path) -> None:
    """What reading a robot's recording makes of images at 8 Hz and poses at 20 Hz of a tracker that is blind for a
    while: the frames with the poses at their times, and the images that are left out."""
    probe = scene.info.probe
    assert probe is not None
    image_s, pose_s = np.arange(0.17, 6.0, 1 / 8), np.arange(0.0, 5.5, 1 / 20)
    pose_s = pose_s[(pose_s < 2.2) | (pose_s > 3.0)]
    with tempfile.TemporaryDirectory() as folder:
        recording = Path(folder, "robot.mcap")
        with recording.open("wb") as file:
            writer = Writer(file)
            schemas = {name: writer.register_msgdef(name, text) for name, text in ros.DEFINITIONS.items()}
            images = render(scene, None, np.stack([_at_time(t) for t in image_s]), height=SIDE, width=SIDE).bmode
            for second, pixels in zip(image_s, to_uint8(images.numpy()), strict=True):
                time_ns = round(second * ros.NS_PER_S)
                writer.write_message("/us/image", schemas[ros.IMAGE], ros.image_message(pixels, time_ns), time_ns)
            for second in pose_s:
                time_ns = round(second * ros.NS_PER_S)
                pose = ros.pose_message(_at_time(second), time_ns)
                writer.write_message("/tracker/pose", schemas[ros.POSE], pose, time_ns)
            writer.finish()
        recording.with_name("robot.geometry.json").write_text(json.dumps({"probe": to_dict(probe)}))
        sweep, _ = read_mcap_sweep(recording)
    shown = range(0, len(sweep), len(sweep) // 4)
    figure = plt.figure(figsize=(2.4 * len(shown), 4.4), layout="constrained")
    grid = figure.add_gridspec(2, len(shown), height_ratios=(3, 2))
    for column, place in enumerate(shown):
        panel = figure.add_subplot(grid[0, column], xticks=[], yticks=[])
        panel.imshow(sweep.images[place], cmap="gray", extent=EXTENT_MM)
        number = sweep.frame_numbers[place]
        panel.set_title(f"frame {number} at {image_s[number]:.2f} s", fontsize=8)
    below = figure.add_subplot(grid[1, :], xlabel="time of the stamp, s", ylabel="y of the probe, mm")
    left_out = np.setdiff1d(np.arange(len(image_s)), sweep.frame_numbers)
    below.plot(pose_s, [_at_time(t)[1, 3] for t in pose_s], ".", color="#30a0e0", label="tracked poses")
    below.plot(image_s[sweep.frame_numbers], sweep.poses[:, 1, 3], "+", color="0.1", label="frames, with their poses")
    below.plot(image_s[left_out], np.zeros(len(left_out)), "x", color="#d1495b", label="images that are left out")
    below.legend(loc="upper left", fontsize=8)
    save(figure, path)


def _at_time(second: float) -> Floats:  # [4, 4]
    """A sweep along the spine in 6 s, as a hand does it: faster in the middle."""
    return along_spine(21.0 * (1.0 - np.cos(np.pi * second / 6.0)))


def _seconds(message: Any) -> float:
    """The stamp of a message of ROS 2."""
    return float(message.header.stamp.sec + message.header.stamp.nanosec / 1e9)


def draw_live_in_volume(scene: GaussianScene, path: Path) -> None:
    """A live image in the volume of its scene, as a program that has both shows them, and the volume in its plane."""
    pose = along_spine(OVER_CANAL_MM) @ _about_depth(25.0)
    probe = scene.info.probe
    assert probe is not None
    right, down = pose[:3, 0], pose[:3, 2]
    width, depth = probe.box_mm.right - probe.box_mm.left, probe.far_mm
    corner = pose[:3, 3] - width / 2 * right
    live = render(scene, None, pose, height=SIDE, width=SIDE).bmode[0].numpy()
    in_plane = sample_slice(scene, "echo", VolumeGrid.on_plane(corner, right, down, (width, depth), 0.25))
    low, high = np.array([-width / 2, OVER_CANAL_MM - 22.0, 0.0]), np.array([width / 2, OVER_CANAL_MM + 22.0, depth])
    size, (x, y, z) = high - low, np.eye(3)
    walls = (  # corner, directions and size of those behind and below the image
        ((low[0], high[1], low[2]), x, z, (size[0], size[2])),
        ((low[0], low[1], low[2]), y, z, (size[1], size[2])),
        ((low[0], low[1], high[2]), x, y, (size[0], size[1])),
    )
    figure = plt.figure(figsize=(9.6, 3.6), layout="constrained")
    view, image, cut = figure.subplots(1, 3, width_ratios=(1.35, 1, 1))
    for origin, along, across, extent in walls:
        values = sample_slice(scene, "echo", VolumeGrid.on_plane(origin, along, across, extent, 0.5))
        _draw_in_space(view, values, np.array(origin), (along, across), extent, "0.6", layer=0)
    _draw_in_space(view, live, corner, (right, down), (width, depth), "tab:orange", layer=1)
    corners = [_TO_PAPER @ np.array(one) for one in product(*zip(low, high, strict=True))]
    (left, top), (right_end, bottom) = np.min(corners, axis=0) - 1.0, np.max(corners, axis=0) + 1.0
    view.set(xlim=(left, right_end), ylim=(bottom, top), aspect="equal")
    view.axis("off")
    view.set_title("the volume, and the live image in it", fontsize=9)
    for panel, pixels, title in ((image, live, "Image_demo: B-mode"), (cut, in_plane, "the volume in the same plane")):
        panel.imshow(pixels, cmap="gray", vmin=0, extent=(0, width, depth, 0))
        panel.set_xticks([])
        panel.set_yticks([])
        panel.set_title(title, fontsize=9)
    save(figure, path)


def _about_depth(angle_deg: float) -> Floats:  # [4, 4]
    turn = np.eye(4)
    cosine, sine = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    turn[:2, :2] = [[cosine, -sine], [sine, cosine]]
    return turn


def _draw_in_space(
    panel: Axes,
    pixels: Floats,
    corner: Floats,  # [3] mm
    along_and_across: tuple[Floats, Floats],  # [3] each, of the rows and columns of pixels
    size_mm: tuple[float, float],
    edge: str,
    *,
    layer: int,  # higher ones cover lower ones
) -> None:
    """Draws a plane of space."""
    start, (along, across) = _TO_PAPER @ corner, (_TO_PAPER @ direction for direction in along_and_across)
    place = Affine2D(np.array([[along[0], across[0], start[0]], [along[1], across[1], start[1]], [0, 0, 1]]))
    width, height = size_mm
    extent = (0, width, height, 0)
    panel.imshow(pixels, cmap="gray", vmin=0, extent=extent, transform=place + panel.transData, zorder=layer)
    border = place.transform([(0, 0), (width, 0), (width, height), (0, height)])
    panel.add_patch(Polygon(border, fill=False, edgecolor=edge, linewidth=1.2, zorder=layer + 0.5))


def draw_registration(scene: GaussianScene, path: Path) -> None:
    """A real frame (of the phantom, which the scene was trained from), and what the scene shows where the robot says
    that it was taken: before and after a registration from three frames.
    """
    poses = freehand_poses(24, tilt_deg=5.0, offset_mm=1.0, unrest=3.0)[6:18:4]
    frames = simulate(poses, probe=PHANTOM_PROBE, height=SIDE, width=SIDE)
    true = pose_from_position_quaternion((-400.0, 20.0, 168.0), (0.0, 1.0, 0.0, 0.0))  # base to scene
    flanges = np.linalg.inv(true) @ poses
    old = pose_from_position_quaternion((2.0, 1.0, -2.0), (0.9995, 0.0, 0.0, 0.0315)) @ true  # slipped since
    fit = register_frames(scene, list(frames), flanges, old, within_mm=6.0, within_deg=8.0).fit
    titles = ("real frame", "before", "after")
    at = np.stack([old @ flanges[1], fit.base_to_scene @ flanges[1]])
    shown = render(scene, None, at, height=SIDE, width=SIDE, outputs=("bmode",))["bmode"].detach().numpy()
    edges = cv2.Canny(cv2.GaussianBlur(frames[1], (0, 0), 4.0), 30, 60)
    figure, panels = panel_row(rows=1, columns=len(titles))
    for panel, title, image in zip(panels, titles, (frames[1] / 255.0, *shown), strict=True):
        panel.imshow(image, cmap="gray", vmin=0.0, vmax=1.0, extent=EXTENT_MM)
        panel.contour(np.flipud(edges), levels=[128], colors="#edae49", linewidths=0.6, extent=EXTENT_MM)
        panel.set_title(title)
    save(figure, path)


def draw_hand(picture: Path) -> None:
    """A plane along the sweep of a hand, compounded by three kinds of poses: a tracker that shakes, and a calibration
    that is off."""
    along = np.array([[0.0, -1.0, 0.0, 8.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
    probe = LinearProbe(width_mm=50.0, near_mm=0.0, far_mm=45.0)
    rows = {
        "a tracker that shakes by 0.3 mm and 0.5°": (((0.0,), 121), Errors(noise_mm=0.3, noise_deg=0.5)),
        "a calibration off by 1 mm and 2°": (((0.0, 80.0), 81), Errors(calibration_mm=1.0, calibration_deg=2.0)),
    }
    titles = ("as given", "on the path", "by the true poses")
    figure, panels = panel_row(rows=len(rows), columns=len(titles))
    for row, (name, (passes, errors)) in enumerate(rows.items()):
        sweep = HandSweep.of(*passes)
        given = sweep.recorded(errors)
        path = agreed_path(given)
        on_path = given if path is None else path.of(given)
        sweeps = [one.train for one in (given, on_path, sweep.recorded(Errors()))]
        for column, (title, one) in enumerate(zip(titles, sweeps, strict=True)):
            panel = panels[row * len(titles) + column]
            image = compound(one, "mean", 0.25).reslice(probe, along[None], SIDE, SIDE)[0]
            panel.imshow(image, cmap="gray", vmin=0.0, vmax=1.0, extent=(-25.0, 25.0, 45.0, 0.0))
            panel.set_title(title, fontsize=8)
        panels[row * len(titles)].set_ylabel(name, fontsize=8)
    save(figure, picture)


def panel_row(*, rows: int, columns: int) -> tuple[Figure, Sequence[Axes]]:
    """A figure and its panels, row by row, without ticks."""
    size = (2.4 * columns, 2.55 * rows)
    figure, grid = plt.subplots(rows, columns, figsize=size, squeeze=False, layout="constrained")
    for panel in grid.flat:
        panel.set_xticks([])
        panel.set_yticks([])
    return figure, list(grid.flat)


def save(figure: Figure, path: Path) -> None:
    """Writes a compact PNG of 256 colours."""
    figure.savefig(path, dpi=100)
    plt.close(figure)
    compress(path)


def shrink(source: Path, target: Path, *, width: int) -> None:
    """A smaller copy of a picture."""
    picture = cv2.imread(str(source))
    if picture is None:
        raise SystemExit(f"{source} is no picture: run the tutorial's commands in its folder first")
    size = (width, round(picture.shape[0] * width / picture.shape[1]))
    cv2.imwrite(str(target), cv2.resize(picture, size, interpolation=cv2.INTER_AREA))
    compress(target)


def compress(path: Path) -> None:
    """The same PNG with a palette, a third of the size."""
    from PIL import Image  # comes with matplotlib

    Image.open(path).convert("RGB").quantize(255, dither=Image.Dither.NONE).save(path, optimize=True)


if __name__ == "__main__":
    main()
