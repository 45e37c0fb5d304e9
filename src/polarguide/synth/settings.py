"""What the user may ask for beyond the scene itself, and the scene with these wishes applied."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, replace
from importlib import resources
from pathlib import Path
from typing import Any, Literal

from polarguide.errors import PolarguideError
from polarguide.synth.schema import SceneSpec, parse_scene, read_scene_file
from polarguide.synth.variant import Color

PRESETS = ("figure", "kit", "car", "cup", "water", "proof")
SensorName = Literal["ideal", "imx250myr", "imx250mzr"]


@dataclass(frozen=True)
class SynthSettings:
    """How a scene is rendered and recorded.

    Attributes:
        width, height: size of the pictures; a simulated sensor has twice as many pixels each way.
        samples: paths per pixel and lobe; test views take four times as many.
        seed: of every random draw.
        sensor: "ideal", or a sensor whose raw mosaics are written, too.
        noise: photon and read noise, see ``sensor.noisy``.
        color: see ``variant.Variant``.
        truth: views that get ground truth, "test" or "all".
        points: sparse points to look for.
    """

    width: int = 256
    height: int = 192
    samples: int = 64
    seed: int = 0
    sensor: SensorName = "ideal"
    noise: float = 0.0
    color: Color = "rgb"
    ground_truth: Literal["test", "all"] = "test"
    points: int = 5000

    def data(self) -> dict[str, Any]:
        """As JSON."""
        return asdict(self)

    def check(self) -> None:
        """Raises PolarguideError where a number makes no sense."""
        for flag, value, low, high in (
            ("--size", self.width, 16, 8192), ("--size", self.height, 16, 8192), ("--samples", self.samples, 1, 65536),
            ("--seed", self.seed, 0, 2**31 - 1), ("--noise", self.noise, 0, 100),
        ):  # fmt: skip
            if not low <= value <= high:
                raise PolarguideError(
                    flag, expected=f"{low} to {high}", found=str(value), remedy="See polarguide synth --help."
                )


@dataclass(frozen=True)
class Overrides:
    """Changes to a scene for controlled studies; None leaves what the scene says.

    Attributes:
        views: number of views.
        spacing: degrees between neighbors on a ring.
        roughness, index: of all plastic objects in the foreground.
    """

    views: int | None = None
    spacing: float | None = None
    roughness: float | None = None
    index: float | None = None

    def apply(self, spec: SceneSpec) -> SceneSpec:
        """The scene with the changes."""
        camera = spec.camera
        if self.views is not None:
            camera = replace(camera, views=self.views)
        if self.spacing is not None:
            camera = replace(camera, spacing=self.spacing)
        things = []
        for thing in spec.things:
            material = thing.material
            if thing.foreground and material.type == "plastic":
                if self.roughness is not None:
                    material = replace(material, roughness=self.roughness)
                if self.index is not None:
                    material = replace(material, index=self.index)
            things.append(replace(thing, material=material))
        changed = replace(spec, camera=camera, things=tuple(things))
        # The changes have to pass the checks of a file.
        data = json.loads(json.dumps(changed.data()))
        return parse_scene(data, f"{spec.name} with the flags", folder=spec.folder)


def find_scene(name: str) -> SceneSpec:
    """A preset by name, or a scene file by path.

    Raises:
        PolarguideError: there is neither, or the file is wrong.
    """
    if name in PRESETS:
        with resources.as_file(resources.files("polarguide") / "synth" / "presets" / f"{name}.json") as path:
            return read_scene_file(path)
    if not Path(name).is_file():
        raise PolarguideError(
            name,
            expected=f"a scene file, or one of {', '.join(PRESETS)}",
            found="nothing of this name",
            remedy="docs/dataset.md describes scene files.",
        )
    return read_scene_file(Path(name))
