"""A small U-Net that names the tissue of each pixel, its training and its measure: for the notebook of segmentation."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

IGNORED = 255  # a pixel whose label says nothing
WIDTH = 8  # channels at full size
BATCH = 8
FASTEST_RATE = 1e-2


class UNet(nn.Module):
    """Frames [B, 1, H, W] in [0, 1] to scores [B, classes, H, W]; H and W are multiples of 4."""

    def __init__(self, classes: int) -> None:
        super().__init__()
        self.fine = _block(1, WIDTH)
        self.middle = _block(WIDTH, 2 * WIDTH)
        self.coarse = _block(2 * WIDTH, 4 * WIDTH)
        self.back_to_middle = _block(6 * WIDTH, 2 * WIDTH)
        self.back_to_fine = _block(3 * WIDTH, WIDTH)
        self.scores = nn.Conv2d(WIDTH, classes, 1)

    def forward(self, frames: Tensor) -> Tensor:
        fine = self.fine(frames)
        middle = self.middle(functional.max_pool2d(fine, 2))
        coarse = self.coarse(functional.max_pool2d(middle, 2))
        middle = self.back_to_middle(torch.cat([_doubled(coarse), middle], dim=1))
        fine = self.back_to_fine(torch.cat([_doubled(middle), fine], dim=1))
        scores: Tensor = self.scores(fine)
        return scores


def train_unet(frames: Tensor, labels: Tensor, *, classes: int, steps: int, seed: int) -> UNet:
    """A U-Net trained on frames [F, H, W] in [0, 1] and labels [F, H, W], where `IGNORED` pixels do not count.

    Rare classes weigh more, by the root of their share. Half of the frames are mirrored: anatomy has two sides.
    """
    random = torch.Generator().manual_seed(seed)
    torch.manual_seed(seed)
    net = UNet(classes)
    optimizer = torch.optim.Adam(net.parameters())
    rates = torch.optim.lr_scheduler.OneCycleLR(optimizer, FASTEST_RATE, total_steps=steps)
    counts = torch.bincount(labels[labels != IGNORED].flatten().long(), minlength=classes)
    weights = (counts.sum() / counts.clamp(min=1)).sqrt()
    for _ in range(steps):
        drawn = torch.randint(len(frames), (BATCH,), generator=random)
        seen, wanted = frames[drawn, None], labels[drawn].long()
        if torch.rand((), generator=random) < 0.5:
            seen, wanted = seen.flip(-1), wanted.flip(-1)
        loss = functional.cross_entropy(net(seen), wanted, weights, ignore_index=IGNORED)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        rates.step()
    return net.eval()


@torch.no_grad()
def segmented(net: UNet, frames: Tensor) -> Tensor:  # [F, H, W] in [0, 1] -> [F, H, W]
    """The class of each pixel."""
    return net(frames[:, None]).argmax(dim=1)


def dice(predicted: Tensor, truth: Tensor, label: int) -> float:  # [F, H, W] both
    """How far the masks of a label agree over all frames, from 0 to 1; pixels that are `IGNORED` in truth aside."""
    counted = truth != IGNORED
    found, wanted = (predicted == label) & counted, truth == label
    return 2.0 * float((found & wanted).sum()) / max(float(found.sum() + wanted.sum()), 1.0)


def _block(inputs: int, outputs: int) -> nn.Sequential:
    layers: list[nn.Module] = []
    for channels in (inputs, outputs):
        layers += [nn.Conv2d(channels, outputs, 3, padding=1), nn.BatchNorm2d(outputs), nn.ReLU()]
    return nn.Sequential(*layers)


def _doubled(features: Tensor) -> Tensor:
    return functional.interpolate(features, scale_factor=2)
