"""The surface of a field: the zero set of its signed distance."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from polarguide.core.errors import optional_import
from polarguide.geometry.camera import Camera, seen_at
from polarguide.geometry.scene_frame import scene_frame
from polarguide.results.rendering.mesh import COARSE, Box, Surface, box_around, zero_surface
from polarguide_bench.gnerp.model import FieldModel


def implicit_surface(cameras: Mapping[str, Camera], model: FieldModel, *, resolution: int) -> Surface:
    """The zero set of a model's distance, where at least two cameras may see it: nearer than their own distance.

    Args:
        cameras: at least two. model: model of the run. resolution: voxels along the longest side.

    Raises:
        PolarguideError: there is no surface, or a library is missing.
    """
    optional_import("skimage.measure", "a mesh")
    around = scene_frame(list(cameras.values()))
    reach = around.distance
    coarse = 2 * reach / COARSE
    whole = Box(around.center - reach, coarse, (COARSE, COARSE, COARSE))
    places, distance = _sampled(whole, model)
    near = places[(distance.abs() < coarse) & (_in_pictures(cameras, places) >= 2)]
    box = box_around([near], around.center, reach, resolution)
    places, distance = _sampled(box, model)
    counts = _in_pictures(cameras, places)
    return zero_surface(box, distance, counts)


def _sampled(box: Box, model: FieldModel) -> tuple[Tensor, Tensor]:
    """Places [X, Y, Z, 3] of a box's voxels, and the distances [X, Y, Z] there."""
    x, y, z = (box.low[k] + box.size * (torch.arange(n) + 0.5) for k, n in enumerate(box.counts))
    return torch.stack(torch.meshgrid(x, y, z, indexing="ij"), dim=-1), model.lattice((x, y, z))


def _in_pictures(cameras: Mapping[str, Camera], places: Tensor) -> Tensor:
    """How many cameras have places [..., 3] in their pictures, hidden ones included: [...]."""
    counts = torch.zeros(places.shape[:-1])
    for camera in cameras.values():
        for part, count in zip(places, counts, strict=True):
            count += seen_at((part - camera.center).view(-1, 3), camera)[2].view(count.shape)
    return counts
