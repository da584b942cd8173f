"""A policy that scans to a standard plane in the demo scene, learned in minutes on two cores.

    python examples/scan_policy.py --starts 200

It imitates a teacher that knows where the goal is (DAgger: Ross, Gordon and Bagnell, 2011): the policy acts, the
teacher says what it would have done, and a small convolutional network learns to say the same of the frame alone. What
brought more reward counts for more (reward-weighted regression), so that a penalty for frames of low confidence has
the policy care less for places that the scene does not know. It needs ultragray with its extra gym, and no service.
"""

from __future__ import annotations

import argparse
import time
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from ultragray.geometry.rotations import turns_of
from ultragray.phantom.demo import load_demo_scene
from ultragray_studies.gym import UltragrayVectorEnv

SIDE, ENVIRONMENTS = 64, 64
START = {"start_mm": 10.0, "start_deg": 10.0}
FAR = 4.0  # actions: what is farther away counts as this
BATCH, UPDATES, RATE = 256, 3, 1e-3  # frames of an update; updates a step of the environments; learning rate
SHARE = 0.3  # of the environments in which the teacher acts at first; it fades out


class Policy(nn.Module):
    """From a frame to the motion that is left to the goal, in actions."""

    def __init__(self) -> None:
        super().__init__()
        widths = (1, 16, 32, 64, 64)
        layers = (
            layer
            for before, after in pairwise(widths)
            for layer in (nn.Conv2d(before, after, 3, stride=2, padding=1), nn.ReLU())
        )
        self.layers = nn.Sequential(
            *layers, nn.Flatten(), nn.Linear(64 * (SIDE // 16) ** 2, 256), nn.ReLU(), nn.Linear(256, 6)
        )

    def forward(self, frames: Tensor) -> Tensor:  # [B, H, W, 1] uint8 -> [B, 6]
        left: Tensor = self.layers(frames.movedim(-1, 1).float() / 127.5 - 1.0)
        return left


def environments(count: int, **settings: Any) -> UltragrayVectorEnv:
    return UltragrayVectorEnv(count, load_demo_scene(), height=SIDE, width=SIDE, **START, **settings)


def motions_left(env: UltragrayVectorEnv, poses: np.ndarray[Any, Any]) -> Tensor:  # [N, 4, 4] mm -> [N, 6]
    """What the teacher knows: from poses to the goal, in actions."""
    task, settings = env.tasks[0], env.settings
    to_goal = np.linalg.inv(poses) @ task.goal
    face = np.array([0.0, 0.0, task.site.probe.pivot_depth_mm, 1.0])
    shifts = (to_goal @ face)[:, :3] - face[:3]
    turns = np.degrees(turns_of(to_goal[:, :3, :3]))
    left = np.concatenate([shifts / settings.step_mm, turns / settings.step_deg], axis=1)
    return torch.from_numpy(np.clip(left, -FAR, FAR)).float()


def trained(steps: int, seed: int, **settings: Any) -> Policy:
    """A policy after so many steps of all environments."""
    torch.manual_seed(seed)
    random = np.random.default_rng(seed)
    near = {"reached_mm": 0.2, "reached_deg": 0.4}  # so that it learns to stay at the goal
    env = environments(ENVIRONMENTS, max_episode_steps=24, **near, **settings)
    policy = Policy()
    optimizer = torch.optim.Adam(policy.parameters(), RATE)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, RATE, total_steps=steps * UPDATES)
    frames, infos = env.reset(seed=seed)
    rewards = torch.zeros(ENVIRONMENTS)
    seen: list[tuple[Tensor, Tensor, Tensor]] = []
    for step in range(steps):
        left = motions_left(env, infos["pose"])
        seen.append((frames, left, rewards.exp()))
        with torch.no_grad():
            actions = policy(frames)
        taught = torch.from_numpy(random.random(ENVIRONMENTS) < SHARE * (1.0 - step / steps))
        frames, rewards, *_, infos = env.step(torch.where(taught[:, None], left, actions).clamp(-1.0, 1.0))
        known = [torch.cat(part) for part in zip(*seen, strict=True)]
        for _ in range(UPDATES):
            chosen = torch.from_numpy(random.integers(len(known[0]), size=BATCH))
            told, right, weights = (part[chosen] for part in known)
            error = nn.functional.smooth_l1_loss(policy(told), right, reduction="none", beta=0.2).mean(dim=1)
            loss = (weights * error).sum() / weights.sum()
            optimizer.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            optimizer.step()
            schedule.step()
        if step % 50 == 49:
            print(f"step {step + 1} of {steps}: loss {loss.item():.3f}", flush=True)
    return policy


def tried(policy: Policy, starts: int, seed: int, **settings: Any) -> dict[str, float]:
    """The share of starts that end at the goal within 100 steps, the median of these, and the confidence on the way."""
    env = environments(starts, max_episode_steps=100, min_confidence=settings.pop("min_confidence", 0.0), **settings)
    frames, infos = env.reset(seed=seed)
    is_under_way, is_reached = np.ones(starts, np.bool_), np.zeros(starts, np.bool_)
    lengths, confidences = np.zeros(starts), []
    while is_under_way.any():
        with torch.no_grad():
            actions = policy(frames).clamp(-1.0, 1.0)
        frames, _, reached, over, infos = env.step(actions)
        lengths += is_under_way
        confidences.append(infos["confidence"][is_under_way])
        is_reached |= is_under_way & reached.numpy()
        is_under_way &= ~(reached | over).numpy()
    return {
        "reached": float(is_reached.mean()),
        "steps": float(np.median(lengths[is_reached])) if is_reached.any() else 0.0,
        "confidence": float(np.concatenate(confidences).mean()),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=400, help=f"of {ENVIRONMENTS} environments, to learn from")
    parser.add_argument("--starts", type=int, default=200, help="that it is tried from")
    parser.add_argument("--min-confidence", type=float, default=None)
    parser.add_argument("--low-confidence", choices=("penalty", "mask"), default="penalty")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    settings: dict[str, Any] = {}
    if given.min_confidence is not None:
        settings = {"min_confidence": given.min_confidence, "low_confidence": given.low_confidence}
    began_s = time.perf_counter()
    policy = trained(given.steps, given.seed, **settings)
    print(f"learned in {time.perf_counter() - began_s:.0f} s")
    found = tried(policy, given.starts, given.seed + 1_000_000, **settings)
    print(
        f"{found['reached']:.0%} of {given.starts} starts reached the plane, in {found['steps']:.0f} steps (median); "
        f"mean confidence on the way {found['confidence']:.2f}"
    )


if __name__ == "__main__":
    main()
