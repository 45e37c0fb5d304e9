"""Find the strongest reflections of a scene: the share of specular light in each view, and the strongest Gaussians.

python examples/03_find_what_reflects.py runs/demo
"""

import sys

import torch

import polarguide

run = polarguide.open_run(sys.argv[1])
for name, camera in list(run.cameras.items())[:5]:
    layers = run.render(camera, layers=["specular", "final"])
    share = layers["specular"].sum() / layers["final"].sum()
    print(f"{name}: {100 * share:.1f} % of the light is specular")

strength = torch.sigmoid(run.gaussians["strength_logits"])
strongest = strength.topk(3).indices
print(
    "strongest Gaussians at",
    [[round(x, 3) for x in place] for place in run.gaussians["means"][strongest].tolist()],
)
