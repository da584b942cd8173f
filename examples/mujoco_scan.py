"""A robot arm in MuJoCo that scans the demo scene: its flange carries a probe, contact holds it on the skin.

    pip install mujoco
    python examples/mujoco_scan.py --seconds 3

MuJoCo knows bodies and forces, the scene knows what the probe sees. Both meet at the probe: the pose of its site is
that of a frame, and the skin under the scene's views is the ground that its face is pressed against. The arm follows a
path along the spine, and gives way along its last axis so far as it is pressed. No display is needed.
"""

from __future__ import annotations

import argparse

import mujoco
import numpy as np
import numpy.typing as npt
import torch

from ultragray.phantom.demo import load_demo_scene
from ultragray.rendering.frames import render
from ultragray.scene.gaussians import GaussianScene

Floats = npt.NDArray[np.float64]

FRAME_HZ = 25
PRESS_MM = 5.0  # that the arm reaches into the skin: what gives way is the force
ARM = """
<mujoco>
  <option timestep="0.002" gravity="0 0 0"/>
  <default><joint damping="20"/><position kp="3000"/></default>
  <worldbody>
    <body name="skin" pos="0 0 -0.05"><geom type="box" size="0.2 0.3 0.05" solref="0.02 1" friction="0.1"/></body>
    <body name="shoulder" pos="0 0 0.2">
      <joint name="along" type="slide" axis="0 1 0"/><inertial pos="0 0 0" mass="2" diaginertia="0.01 0.01 0.01"/>
      <body name="elbow">
        <joint name="across" type="slide" axis="1 0 0"/><inertial pos="0 0 0" mass="1" diaginertia="0.01 0.01 0.01"/>
        <body name="wrist">
          <joint name="down" type="slide" axis="0 0 -1"/><joint name="tilt" type="hinge" axis="1 0 0" pos="0 0 -0.19"/>
          <geom name="probe" type="capsule" fromto="-0.03 0 -0.19 0.03 0 -0.19" size="0.005" mass="0.5"/>
          <site name="face" pos="0 0 -0.195" euler="180 0 0"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="along" joint="along"/><position name="across" joint="across"/>
    <position name="down" joint="down" kp="600"/><position name="tilt" joint="tilt" kp="40"/>
  </actuator>
  <sensor><touch name="force" site="touch"/></sensor>
</mujoco>
""".replace(
    '<site name="face"', '<site name="touch" pos="0 0 -0.19" type="box" size="0.04 0.01 0.01"/><site name="face"'
)


class ProbeSensor:
    """The frame of a probe at a site of a model: x lateral, y elevation, z into the body, lengths in metres."""

    def __init__(self, scene: GaussianScene, model: mujoco.MjModel, site: str, world_to_scene: Floats) -> None:
        self._scene, self._to_scene = scene, world_to_scene  # [4, 4] mm
        self._site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, site)

    def pose(self, data: mujoco.MjData) -> Floats:  # [4, 4] mm, probe→scene
        pose = np.eye(4)
        pose[:3, :3] = data.site_xmat[self._site].reshape(3, 3)
        pose[:3, 3] = 1000.0 * data.site_xpos[self._site]
        placed: Floats = self._to_scene @ pose
        return placed

    def read(self, data: mujoco.MjData, side: int = 128) -> tuple[npt.NDArray[np.float32], float]:
        """The frame [side, side] in [0, 1], and the share of its scan lines with contact."""
        with torch.no_grad():
            frames = render(
                self._scene, None, self.pose(data), height=side, width=side, outputs=("bmode",), contact="air"
            )
        assert frames.touch is not None
        return frames["bmode"][0].numpy(), float(frames.touch.shares[0])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=3.0, help="of the simulation")
    given = parser.parse_args()
    scene = load_demo_scene()
    model = mujoco.MjModel.from_xml_string(ARM)
    data = mujoco.MjData(model)
    views = scene.training_poses
    begin, end = views[0, 1, 3] / 1000.0, views[-1, 1, 3] / 1000.0
    # The skin of the model is its plane z = 0, z upwards; that of the scene z = 0 mm, z into the body.
    world_to_scene = np.diag([1.0, -1.0, -1.0, 1.0])
    sensor = ProbeSensor(scene, model, "face", world_to_scene)
    steps = round(1.0 / FRAME_HZ / model.opt.timestep)
    count = round(given.seconds * FRAME_HZ)
    for number in range(count):
        share = number / max(count - 1, 1)
        data.ctrl[:] = (
            -(begin + share * (end - begin)) * 0.5,
            0.0,
            0.005 + PRESS_MM / 1000.0,
            0.04 * np.sin(6.0 * share),
        )
        mujoco.mj_step(model, data, nstep=steps)
        if number % FRAME_HZ == FRAME_HZ - 1:
            frame, contact = sensor.read(data)
            x, y, z = sensor.pose(data)[:3, 3]
            force_n = data.sensor("force").data[0]
            print(
                f"{data.time:.1f} s: probe at {x:.1f}, {y:.1f}, {z:.1f} mm, pressed with {force_n:.1f} N, "
                f"contact {contact:.0%}, brightness {frame.mean():.2f}"
            )


if __name__ == "__main__":
    main()
