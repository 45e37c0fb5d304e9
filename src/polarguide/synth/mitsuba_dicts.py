"""Mitsuba dictionaries of BSDFs and emitters, for one color channel, or for all wavelengths if ``channel`` is None."""

from __future__ import annotations

from typing import Any

import numpy as np

from polarguide.errors import PolarguideError
from polarguide.synth.mesh import Array
from polarguide.synth.schema import Material, SceneSpec
from polarguide.synth.transport import SHOWN

AIR = 1.0


def bsdf_dict(material: Material, picture: Array | None, channel: int | None) -> dict[str, Any]:
    """The BSDF of a material, with the texture ``picture`` [H, W, 3] if it has one."""
    base = _value(material.color, channel) if picture is None else _bitmap(picture, channel)
    if material.type == "metal":
        index = {name: _metal(getattr(material, name), channel) for name in ("eta", "k")}
        inner = {"type": "roughconductor", "distribution": "ggx", "alpha": material.roughness, **index}
    elif material.type == "matte":
        inner = {"type": "diffuse", "reflectance": base}
    else:
        inner = {"type": "pplastic", "distribution": "ggx", "alpha": material.roughness, "diffuse_reflectance": base,
                 "int_ior": float(material.index), "ext_ior": AIR}  # fmt: skip
    return {"type": "twosided", "inner": inner}


def _value(color: Any, channel: int | None) -> dict[str, Any]:
    """The dictionary of a reflectance or radiance."""
    if channel is None:
        return {"type": "rgb", "value": [float(c) for c in color]}
    return {"type": "uniform", "value": float(color[channel])}


def _metal(index: tuple[float, float, float], channel: int | None) -> dict[str, Any]:
    """The spectrum of an index that is given at red, green and blue."""
    if channel is not None:
        return {"type": "uniform", "value": float(index[channel])}
    red, green, blue = index
    values = f"{blue}, {blue}, {green}, {red}, {red}"
    return {"type": "irregular", "wavelengths": "360, 450, 545, 620, 830", "values": values}


def _bitmap(picture: Array, channel: int | None) -> dict[str, Any]:
    import mitsuba as mi

    part = picture if channel is None else picture[..., channel : channel + 1]
    # Rows of a picture go down, v goes up.
    data = np.ascontiguousarray(part[::-1], np.float32)
    blend = "nearest" if len(data) == 1 else "bilinear"  # a palette has one row
    return {"type": "bitmap", "bitmap": mi.Bitmap(data), "raw": channel is not None, "filter_type": blend}


def environment_dict(panorama: Array, channel: int | None) -> dict[str, Any]:
    """The environment emitter of a panorama [H, W, 3]."""
    import mitsuba as mi

    part = panorama if channel is None else np.repeat(panorama[..., channel : channel + 1], 3, -1)
    # The left edge of Mitsuba's panoramas is its -z; y is up and columns proceed to the right.
    axes = np.array([[0, 0, -1, 0], [-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]], float)
    return {"type": "envmap", "bitmap": mi.Bitmap(np.ascontiguousarray(part, np.float32)),
            "to_world": mi.ScalarTransform4f(axes)}  # fmt: skip


def shown_dict(spec: SceneSpec, shown: bool) -> dict[str, Any]:
    """The attribute of a shape that says whether the camera sees it; nothing where it sees all."""
    return {SHOWN: {"type": "uniform", "value": float(shown)}} if spec.object_only else {}


def area_light_dict(light: dict[str, Any], channel: int | None, where: str) -> dict[str, Any]:
    """A rectangular area light.

    Raises:
        PolarguideError: a field is missing or has another type; ``where`` names the scene.
    """
    import mitsuba as mi

    try:
        position, toward = list(light["position"]), list(light["toward"])
        half = [float(s) / 2 for s in light["size"]]
        radiance = [float(v) for v in light["radiance"]]
    except (KeyError, TypeError, ValueError) as error:
        raise PolarguideError(
            f"{where} (lights)",
            expected="position, toward, size and radiance of each light",
            found=repr(error),
            remedy="docs/reference/scene-files.md describes them.",
        ) from error
    plain = len(position) == len(toward) == len(radiance) == 3 and len(half) == 2
    if not plain or position == toward or min(half) <= 0 or min(radiance) < 0:
        raise PolarguideError(
            f"{where} (lights)",
            expected="two different places, a size above 0, and radiance of 0 or more, of each light",
            found=str(light)[:200],
            remedy="docs/reference/scene-files.md describes them.",
        )
    up = (
        [0, 0, 1]
        if abs(toward[2] - position[2]) < 0.99 * np.linalg.norm(np.subtract(toward, position))
        else [0, 1, 0]
    )
    place = mi.ScalarTransform4f().look_at(position, toward, up) @ mi.ScalarTransform4f().scale([*half, 1.0])
    return {"type": "rectangle", "to_world": place, "emitter": {"type": "area", "radiance": _value(radiance, channel)},
            "bsdf": {"type": "diffuse", "reflectance": _value((0.0, 0.0, 0.0), channel)}}  # fmt: skip
