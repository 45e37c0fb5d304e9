"""The objects of a scene whose ground truth says which pixel shows which: the table ``objects`` in ``scene.json``."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec

from polarguide.errors import PolarguideError
from polarguide.records import decode

ROUGH = 0.15
"""GGX roughness above which a surface is called rough: its lobe is wider than some nine degrees to each side."""
LARGEST_ID = 65535
MaterialClass = Literal["metal", "rough metal", "dielectric", "rough dielectric", "matte"]
METAL_CLASSES: tuple[MaterialClass, ...] = ("metal", "rough metal")
METALS = ("metal", "conductor", "roughconductor")
DIELECTRICS = ("plastic", "pplastic", "roughplastic", "dielectric", "roughdielectric", "principled")
MATTE = ("matte", "diffuse")
_REMEDY = "Correct it, or remove objid from the ground truth: then errors are not told apart by object."


class Material(msgspec.Struct, frozen=True):
    """A surface as ``scene.json`` names it; what else it says is passed over.

    Attributes:
        type: such as "plastic" or "roughconductor". alpha: GGX roughness. ior: refractive index. k: extinction.
    """

    type: str = ""
    alpha: Annotated[float, msgspec.Meta(ge=0)] | None = None
    ior: Any = None
    k: Any = None

    @property
    def kind(self) -> MaterialClass | None:
        """The class that errors are told apart by; None where the table does not say enough.

        A metal has an extinction ``k`` or the type of one, a dielectric an index ``ior`` or the type of one. Either is
        rough if its ``alpha`` exceeds ``ROUGH``. Matte is what has no reflection of its own at all.
        """
        rough = self.alpha is not None and self.alpha > ROUGH
        if self.type in METALS or self.k is not None:
            return "rough metal" if rough else "metal"
        if self.type in DIELECTRICS or self.ior is not None:
            return "rough dielectric" if rough else "dielectric"
        return "matte" if self.type in MATTE else None


class SceneObject(msgspec.Struct, frozen=True):
    """An object of the scene.

    Attributes:
        id: its number in ``objid`` of the ground truth, from 1 up; 0 is no object.
        name: unique. foreground: whether it belongs to the mask. material: its surface.
    """

    id: Annotated[int, msgspec.Meta(ge=1, le=LARGEST_ID)]
    name: Annotated[str, msgspec.Meta(min_length=1)]
    foreground: bool = True
    material: Material = Material()


class _Scene(msgspec.Struct):
    """What is read of ``scene.json``."""

    objects: list[SceneObject] | None = None


def objects_of(path: Path, data: bytes | None) -> tuple[SceneObject, ...]:
    """The table of objects in ``scene.json``; empty if there is none.

    Args:
        path: ``scene.json``, for messages. data: its content, or None if there is no such file.

    Raises:
        PolarguideError: an object has no number or name, or shares it with another.
    """
    if data is None:
        return ()
    objects = decode(data, _Scene, path, remedy=_REMEDY).objects or []
    for field in ("id", "name"):
        counts = Counter(getattr(item, field) for item in objects)
        twice, times = next(iter(counts.most_common(1)), (None, 0))
        if times > 1:
            raise PolarguideError(
                f"{path} (objects)",
                expected=f"objects of which each has its own {field}",
                found=f"two with the {field} {twice}",
                remedy=_REMEDY,
            )
    return tuple(objects)
