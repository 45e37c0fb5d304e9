"""Train with your own callback: no Gaussian becomes completely opaque.

python examples/05_train_with_a_callback.py src/polarguide/data/demo runs/capped 400
"""

import math
import sys

import torch

import polarguide
from polarguide.training.callback import Callback


class OpacityCap(Callback):
    """Callback that clamps opacities to a limit at regular steps, and counts the changes."""

    name = "opacity_cap"

    def __init__(self, limit, every):
        self.limit = math.log(limit / (1 - limit))
        self.every = every
        self.capped = 0

    def after_step(self, loop, report):
        if loop.state.step % self.every:
            return
        gaussians = loop.state.gaussians
        logits = gaussians["opacity_logits"].detach()
        self.capped += int((logits > self.limit).sum())
        gaussians.overwrite("opacity_logits", logits.clamp(max=self.limit))

    def state_dict(self):
        return {"capped": torch.tensor(self.capped)}

    def load_state_dict(self, tensors):
        self.capped = int(tensors["capped"])


if __name__ == "__main__":
    cap = OpacityCap(limit=0.9, every=20)
    scene = polarguide.load_scene(sys.argv[1], downscale=2)
    settings = polarguide.TrainSettings(steps=int(sys.argv[3]))
    polarguide.train(scene, sys.argv[2], settings=settings, callbacks=[cap])
    print(f"capped {cap.capped:,} opacities")
