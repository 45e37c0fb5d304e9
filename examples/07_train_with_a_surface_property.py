"""Train with a surface property of your own: every Gaussian learns a clear coat that reflects the environment.

python examples/07_train_with_a_surface_property.py src/polarguide/data/demo runs/coated 400
"""

import sys
from dataclasses import dataclass, replace

import torch

import polarguide
from polarguide.methods import recipe_named
from polarguide.shading.deferred import DeferredShading
from polarguide.shading.surface import SurfaceProperty

COAT = SurfaceProperty(
    "coat",  # name of the layer, and of the field in polarguide.ply
    "coat_logits",  # name of the trained tensor
    activation=torch.sigmoid,  # value of the trained number
    inverse=torch.logit,
    initial=0.3,
    rate=0.05,
)


@dataclass(frozen=True)
class CoatedShading(DeferredShading):
    """final = base + strength F light + 0.04 coat light, with Fresnel's reflectance F."""

    @property
    def surface(self):
        return (*super().surface, COAT)

    def shade(self, splatted, light, camera):
        layers = super().shade(splatted, light, camera)
        coat = 0.04 * layers["coat"][..., None] * layers["reflection"]
        return {**layers, "final": layers["final"] + coat, "specular": layers["specular"] + coat}


if __name__ == "__main__":
    scene = polarguide.load_scene(sys.argv[1], downscale=4)
    settings = polarguide.TrainSettings(steps=int(sys.argv[3]))
    recipe = replace(recipe_named("polarguide"), name="coated", shading=CoatedShading("fresnel"))
    run = polarguide.train(scene, sys.argv[2], recipe=recipe, settings=settings)
    camera = scene.view(scene.test_names[0]).camera
    coat = run.result(camera).layers["coat"]
    print(f"coat: mean {coat.mean():.2f}, largest {coat.max():.2f}")
    run.export("ply", f"{sys.argv[2]}/export", fields="all")
