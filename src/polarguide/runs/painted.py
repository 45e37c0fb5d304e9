"""Materials that the user painted in the viewer of a run, stored as RUN/materials/<view>.png.

The pictures have the size of the training views and contain the numbers of the scene's materials. They take precedence
over the materials of the scene.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from PIL import Image
from torch import Tensor

from polarguide.capture import Scene
from polarguide.capture.formats.pictures import SUFFIXES, decode_materials
from polarguide.capture.layout import index_files
from polarguide.core.errors import PolarguideError
from polarguide.core.files import atomic_folder, read_file

FOLDER = "materials"
"""Name of the folder of painted materials in a run folder."""
LARGEST = 1 << 26
"""Largest size of a file in bytes."""
REMEDY = "Paint and save again in polarguide view RUN, or remove the folder."


@dataclass(frozen=True, eq=False)
class PaintedMaterials:
    """Painted materials of the training views.

    Attributes:
        numbers: material of each pixel by view, [H, W] uint8. 0 means no label, 1 dielectric, and 2 metal. Larger
            numbers are defined in ``scene.json``.
        digest: SHA-256 of the files.
    """

    numbers: Mapping[str, Tensor]
    digest: str

    def over(self, scene: Scene) -> Scene:
        """Return a scene with these materials on labeled pixels."""
        views = []
        for view in scene.views:
            materials = view.materials
            painted = self.numbers.get(view.name)
            if painted is not None:
                materials = painted if materials is None else torch.where(painted > 0, painted, materials)
            views.append(replace(view, materials=materials))
        return replace(scene, views=tuple(views))


def read_painted(run: Path, scene: Scene) -> PaintedMaterials | None:
    """Read the painted materials of a run. Return None if no pixel has a label.

    Raises:
        PolarguideError: a picture belongs to no view or to a held-out view, is damaged, has another size, or has a
            number that ``scene.json`` does not define.
    """
    if not os.path.lexists(run / FOLDER):  # a broken link is an error, not a missing folder
        return None
    digest = hashlib.sha256()
    numbers = dict[str, Tensor]()
    defined = {0, 1, 2, *scene.indices}
    for name, path in sorted(index_files(run / FOLDER, SUFFIXES).items()):
        camera = scene.view(name).camera
        data = read_file(path, largest=LARGEST, remedy=REMEDY)
        picture = torch.from_numpy(decode_materials(path, data))
        size = (camera.height, camera.width)
        shape = tuple(picture.shape)
        if shape != size:
            raise PolarguideError(
                path,
                expected=f"{camera.width}x{camera.height} pixels, the size of the training view",
                found=f"{shape[1]}x{shape[0]}",
                remedy=REMEDY,
            )
        if unknown := set(picture.unique().tolist()) - defined:
            listed = ", ".join(map(str, sorted(defined)))
            raise PolarguideError(
                path, expected=f"the numbers {listed}", found=str(min(unknown)), remedy=REMEDY
            )
        if name in scene.test_names and bool(picture.any()):
            raise PolarguideError(
                path,
                expected="a training view",
                found=f"{name}, which is held out for tests, so that its materials have no effect",
                remedy="Paint a training view in polarguide view RUN, and remove this picture.",
            )
        digest.update(name.encode() + b"\0" + picture.numpy().tobytes())
        numbers[name] = picture
    says = any(bool(picture.any()) for picture in numbers.values())
    return PaintedMaterials(numbers, digest.hexdigest()) if says else None


def write_painted(run: Path, numbers: Mapping[str, Tensor]) -> None:
    """Replace the painted materials of a run.

    Args:
        run: the run folder.
        numbers: [H, W] uint8 of every training view.

    Raises:
        PolarguideError: the materials cannot be written; the previous ones remain.
    """
    with atomic_folder(run / FOLDER) as folder:
        for name, picture in numbers.items():
            Image.fromarray(picture.numpy()).save(folder / f"{name}.png")
