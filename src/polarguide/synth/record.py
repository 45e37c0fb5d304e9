"""``scene.json`` of a rendered scene: what was rendered, how, and by which conventions."""

from __future__ import annotations

import importlib.metadata
from typing import Any

from polarguide import __version__
from polarguide.synth.schema import SceneSpec
from polarguide.synth.settings import SynthSettings
from polarguide.synth.variant import Variant

CONVENTION = {
    "intensity": "I_a = (S0 + S1 cos 2a + S2 sin 2a) / 2 is PNG value / 65535, linear",
    "aolp": "atan2(S2, S1) / 2 from the image's horizontal, counter-clockwise as displayed, in the lens frame of "
    "each ray (docs/explanation/conventions.md)",
    "camera": "OpenCV axes, world to camera x_cam = R x_world + t, pixel centers at 0.5",
    "truth": "gt/<view>.npz: stokes, specular and diffuse as S0 of the lobes of the first surface, exposed like "
    "the pictures, whose sum is S0 on surfaces; normal (world), depth (camera z), mask, objid at pixel centers",
    "environment": "environment.hdr: rows from +z down, columns clockwise seen from above, from +x; scene units",
}


def scene_record(
    spec: SceneSpec,
    settings: SynthSettings,
    variant: Variant,
    names: list[str],
    tests: list[str],
    *,
    exposure: float,
    clipped: float,
) -> dict[str, Any]:
    """The content of ``scene.json``."""
    objects = []
    for number, thing in enumerate(spec.things, 1):
        source = thing.material
        material: dict[str, Any] = {"type": source.type, "diffuse": source.color}
        if source.type == "plastic":
            material |= {"alpha": source.roughness, "ior": source.index}
        elif source.type == "metal":
            material = {"type": "metal", "alpha": source.roughness, "eta": source.eta, "k": source.k}
        objects.append({"id": number, "name": thing.name, "mesh": f"mesh/{thing.name}.ply",
                        "foreground": thing.foreground, "material": material})  # fmt: skip
    return {
        "scene": spec.name,
        "about": spec.about,
        "width": settings.width,
        "height": settings.height,
        "fov_x_deg": spec.camera.fov,
        "views": names,
        "train": [name for name in names if name not in tests],
        "test": tests,
        "exposure": exposure,
        "exposure_note": "radiance * exposure = values in polar/ and gt/; I_a clips at 1",
        "clipped_share": round(clipped, 6),
        "noise": {"enabled": settings.noise > 0, "level": settings.noise},
        "stokes_frame": "lens",
        "stokes_convention": CONVENTION,
        "objects": objects,
        "world_up": "+z",
        "spp": settings.samples,
        "max_depth": spec.depth,
        "seed": settings.seed,
        "renderer": {
            "mitsuba": importlib.metadata.version("mitsuba"),
            "variant": variant.name,
            "polarguide": __version__,
        },
        "settings": settings.data(),
    }
