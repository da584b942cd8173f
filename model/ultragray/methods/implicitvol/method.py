"""ImplicitVol as methods: with the tracker's poses, and with poses that are refined."""

from __future__ import annotations

import torch

from ultragray.datasets.sweep import Dataset
from ultragray.methods.budget import Budget
from ultragray.methods.implicitvol.learner import EPOCHS, FieldLearner, RefiningLearner
from ultragray.methods.learner import LearnedMethod, Learner
from ultragray.methods.method import Description

PUBLISHED_FRAMES = 128  # of the paper's example
SOURCE = "Yeung et al., arXiv 2109.12108"
FIELD_EQUATIONS = (
    "p = (R x + t - c) / (H_mm / 2), H_mm the height of the image, c the centre of the scene",
    "e(p) = (p, sin p, cos p, sin 2p, cos 2p, ..., sin 2^9 p, cos 2^9 p), 63 numbers",
    "a sine layer: sin(w0 (W x + b)), w0 = 30 in the first, 1 in the others",
    "h = S4(S3(S2(S1(e)))), g = S8(S7(S6(S5(h, e)))), v(p) = L2(S9(L1(g)))",
    "loss = 1 - SSIM(v, image), window 5, sigma 1.5, zeros around the image",
)
FIELD_CHOICES = (
    "The centre of the scene is the mean of the corners of the training frames.",
    "The height of an image is the length of its scan lines, of a convex probe too.",
    "The paper's schedule over 10,001 epochs is stretched to the steps of the budget.",
    "Linear layers begin uniform in ±1/sqrt(inputs), which the paper leaves open.",
    "1 - SSIM in place of -SSIM: the same gradient, and a loss that ends at 0.",
    "SSIM takes an image and its negative for the same; the paper does not say what keeps a fit from the negative, and "
    "nothing does here.",
    "Values are cut off at 0 and 1 where a frame is rendered, not where it is learned.",
)


class ImplicitVol(LearnedMethod):
    """The field alone, with the tracker's poses."""

    name = "implicitvol"

    def describe(self) -> Description:
        return Description(
            title="ImplicitVol",
            source=SOURCE,
            summary="A network of sine layers gives the grey value of a point; a frame is its values at the pixels.",
            equations=FIELD_EQUATIONS,
            choices=("Poses stay the tracker's: all methods see the same.", *FIELD_CHOICES),
            published_steps=EPOCHS * PUBLISHED_FRAMES,
        )

    def published_steps(self, dataset: Dataset) -> int:
        """An epoch takes one step for each training frame."""
        return EPOCHS * len(dataset.train)

    def learner(self, dataset: Dataset, budget: Budget, seed: int, device: torch.device) -> Learner:
        return FieldLearner(dataset, seed, device)


class RefinedImplicitVol(ImplicitVol):
    """The field together with the poses of the training frames; those of held-out frames stay as they are given."""

    name = "implicitvol-refined"

    def describe(self) -> Description:
        return Description(
            title="ImplicitVol, poses refined",
            source=SOURCE,
            summary="As ImplicitVol, and three angles and three translations of each training frame are learned too.",
            equations=(*FIELD_EQUATIONS, "R = M Rz Ry Rx, about the middle of the image"),
            choices=(
                "M is the mean rotation of the tracked frames, so that no frame comes near the angles where Rz Ry Rx "
                "has only two independent ones.",
                "Held-out poses stay as they are given. The paper fixes no common motion of field and frames: here the "
                "rigid motion that carries the tracked training frames onto the refined ones best is applied to them.",
                "A restart of the network clears what the optimisers remember, not their schedules.",
                "One Adam has the poses of all frames: a frame also moves in the steps of others, by its momentum.",
                *FIELD_CHOICES,
            ),
            published_steps=EPOCHS * PUBLISHED_FRAMES,
        )

    def learner(self, dataset: Dataset, budget: Budget, seed: int, device: torch.device) -> Learner:
        return RefiningLearner(dataset, seed, device)
