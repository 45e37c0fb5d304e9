"""Export of a textured mesh as Wavefront OBJ: geometry, material and textures as files.

Roughness and metalness are in the fields ``map_Pr`` and ``map_Pm`` of Clara.io's extension, which Blender
reads.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from polarguide.core.files import atomic_folder
from polarguide.results.export.model.gltf import Pixels, Textured, encoded

NAME = "model"
"""Stem of the files."""
_GRAY = 3


def write_obj(folder: Path, model: Textured, lines: Sequence[str], *, jpeg: bool) -> list[Path]:
    """Write ``model.obj``, ``model.mtl`` and the textures ``model-color``, ``model-roughness`` and ``model-metalness``.

    Args:
        folder: folder to write. model: the mesh. lines: comments. jpeg: encode the color as JPEG instead of
            PNG.

    Raises:
        PolarguideError: a file cannot be written.
    """
    pictures: dict[str, Pixels] = {"color": model.base_color}
    if model.surface is not None:
        for channel, name in ((1, "roughness"), (2, "metalness")):
            pictures[name] = np.repeat(model.surface[..., channel, None], _GRAY, axis=2)
    names = {name: f"{NAME}-{name}.{'jpg' if jpeg and name == 'color' else 'png'}" for name in pictures}
    head = "".join(f"# {line}\n" for line in lines)
    with atomic_folder(folder) as temporary:
        for name, pixels in pictures.items():
            (temporary / names[name]).write_bytes(encoded(pixels, jpeg=jpeg and name == "color")[1])
        (temporary / f"{NAME}.mtl").write_text(head + _material(names, model), encoding="ascii")
        (temporary / f"{NAME}.obj").write_text(head + _geometry(model), encoding="ascii")
    return [folder / f"{NAME}.obj", folder / f"{NAME}.mtl", *(folder / name for name in names.values())]


def _material(names: dict[str, str], model: Textured) -> str:
    lit = "roughness" in names
    lines = ["newmtl surface", "Kd 1 1 1", f"map_Kd {names['color']}"]
    if lit:
        lines += [f"Ni {model.index:g}", f"map_Pr {names['roughness']}", f"map_Pm {names['metalness']}"]
    return "\n".join([*lines, f"illum {2 if lit else 0}"]) + "\n"  # 0 means constant color.


def _geometry(model: Textured) -> str:
    uv = np.stack([model.uv[:, 0], 1 - model.uv[:, 1]], axis=1)  # In OBJ v starts at the last row.
    numbers = model.faces + 1
    lines = [f"mtllib {NAME}.mtl", "usemtl surface"]
    for word, values in (("v", model.vertices), ("vt", uv), ("vn", model.normals)):
        lines += [f"{word} {' '.join(f'{number:.7g}' for number in row)}" for row in values.tolist()]
    lines += [f"f {a}/{a}/{a} {b}/{b}/{b} {c}/{c}/{c}" for a, b, c in numbers.tolist()]
    return "\n".join(lines) + "\n"
