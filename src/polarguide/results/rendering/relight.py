"""Relighting of a run, and conversion between learned environments and panoramas.

A panorama [H, 2 H, 3] is upright in the scene. Row i, column j is at latitude ``pi (1/2 - (i + 1/2) / H)`` above the
cameras' common level, and at longitude ``pi ((j + 1/2) / H - 1)`` from the middle to the right. Files have linear
radiance on the scale of the photographs (S0 / 2), in the color of the run's presentation.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import grid_sample, pad

from polarguide.capture.formats.pictures import read_radiance
from polarguide.capture.presentation import in_camera
from polarguide.core.errors import PolarguideError, optional_import
from polarguide.core.files import atomic, in_utf8, write_whole
from polarguide.core.options import PathLike
from polarguide.core.progress import SILENT, Advance, Reporter
from polarguide.geometry.scene_frame import SceneFrame
from polarguide.geometry.vectors import unit
from polarguide.runs.opened import OpenedRun
from polarguide.shading.cubemap import cubemap_lookup, texel_directions
from polarguide.shading.model import RadianceCubemap, ShadingModel, mirrored, radiance_cubemap

LARGEST = 8192 * 4096
RELIT_RESOLUTION = 128
"""Number of texels along a side of a cubemap that is resampled from a panorama or rotated."""


def relight(
    run: OpenedRun, panorama: PathLike | None = None, degrees: float = 0.0, *, reporter: Reporter = SILENT
) -> None:
    """Replace the learned environment of a run in memory by a panorama, or rotate it.

    Args:
        run: the run; its scene is read.
        panorama: file of linear radiance (.hdr, .exr) that replaces the learned environment.
        degrees: rotation of the environment, counter-clockwise seen from above.
        reporter: receives a note about layers that keep their learned light.

    Raises:
        PolarguideError: the recipe learns no radiance, or the file cannot be read.
    """
    if panorama is None and degrees % 360 == 0:
        return
    what = "rotate_environment" if panorama is None else "environment"
    if not math.isfinite(degrees):
        raise PolarguideError(what, expected="finite degrees", found=str(degrees), remedy="Enter a number.")
    cubemap = needs_radiance(run.model.shading, what=what)
    light = run.model.light
    around = run.frame
    if panorama is not None:
        picture = in_camera(read_panorama(Path(panorama)), run.presentation.color)
        texels = cubemap_of_panorama(picture, cubemap, around, RELIT_RESOLUTION)
        light[cubemap.name] = texels.to(light[cubemap.name].device)
    light[cubemap.name] = turned_cubemap(light[cubemap.name].detach(), around.turn(degrees), RELIT_RESOLUTION)
    if cubemap.note:
        reporter.say(f"note: {cubemap.note}")


def needs_radiance(shading: ShadingModel, *, what: str) -> RadianceCubemap:
    """Return the radiance cubemap of a shading model's light.

    Args:
        shading: the shading model.
        what: the option that needs the cubemap, for the message.

    Raises:
        PolarguideError: the model has no light, or its light is not a cubemap of radiance.
    """
    cubemap = radiance_cubemap(shading)
    if cubemap is not None:
        return cubemap
    raise PolarguideError(
        what,
        expected="a recipe that learns the radiance of its surroundings",
        found="a recipe with another kind of light"
        if "specular" in shading.layers
        else "a run without reflection",
        remedy="Choose a run of 3dgs-dr, polarguide or polarguide-stokes.",
    )


@torch.no_grad()
def mirrored_light(run: OpenedRun, cubemap: RadianceCubemap, advance: Advance) -> Tensor:
    """Combine the learned environment and the local light of the Gaussians into raw texels [6, R, R, 3].

    Each texel is a weighted mean over the pixels of all training views that reflect light from its direction. The
    weight of a pixel is the square of its reflected share, which gives the least-squares fit to the specular layers.
    The learned environment counts as one additional pixel with full strength at normal incidence.
    """
    texels = run.light[cubemap.name].detach().cpu()
    shading = run.model.shading
    sums = torch.zeros(*texels.shape[:3], 4, requires_grad=True)
    views = run.scene.train_views
    for count, view in enumerate(views, 1):
        result = run.result(view.camera).to("cpu")
        light = result.layers["reflection"]
        ratio = result.layers["specular"].sum(-1) / light.sum(-1).clamp(min=1e-6)
        share = ratio.clamp(0, 1)[..., None].square()
        directions = mirrored(view.camera.world_rays(), unit(result.normal, 1e-3)).reshape(-1, 3)
        with torch.enable_grad():
            # The gradient of a texture look-up distributes the value of a pixel among its texels.
            cubemap_lookup(sums, directions).backward(
                torch.cat([share * light, share], dim=-1).reshape(-1, 4)
            )
        advance(count)
    assert sums.grad is not None
    total, weight = sums.grad.split([3, 1], dim=-1)
    own = ((shading.refractive_index - 1) / (shading.refractive_index + 1)) ** 4
    return cubemap.raw((total + own * cubemap.radiance(texels)) / (weight + own))


@torch.no_grad()
def panorama(texels: Tensor, cubemap: RadianceCubemap, around: SceneFrame, height: int) -> Tensor:
    """Convert raw texels [6, R, R, 3] of a cubemap to a panorama of radiance [H, 2 H, 3]."""
    steps = torch.arange(2 * height, dtype=torch.float64) + 0.5
    latitude = math.pi * (0.5 - steps[:height, None] / height)
    longitude = math.pi * (steps[None] / height - 1)
    x, y, z = torch.broadcast_tensors(
        latitude.cos() * longitude.sin(), latitude.sin(), -latitude.cos() * longitude.cos()
    )
    directions = torch.stack((x, y, z), dim=-1).reshape(-1, 3) @ around.panorama_axes().T
    radiance = cubemap_lookup(texels.detach(), directions.to(texels.dtype))
    return cubemap.radiance(radiance).reshape(height, 2 * height, 3)


@torch.no_grad()
def cubemap_of_panorama(
    picture: Tensor, cubemap: RadianceCubemap, around: SceneFrame, resolution: int
) -> Tensor:
    """Convert a panorama of radiance [H, W, 3] to raw texels [6, R, R, 3], clamped to the range of raw values."""
    directions = texel_directions(resolution).double() @ around.panorama_axes()
    x, y, z = directions.unbind(-1)
    across = torch.atan2(x, -z) / math.pi
    down = -2 / math.pi * torch.asin(y.clamp(-1, 1))
    # The panorama is periodic, so a column is added on each side.
    wide = pad(picture.double().movedim(-1, 0)[None], (1, 1, 0, 0), mode="circular")
    width = picture.shape[1]
    places = torch.stack((across * width / (width + 2), down), dim=-1).reshape(
        1, 6 * resolution, resolution, 2
    )
    sampled = grid_sample(wide, places, mode="bilinear", padding_mode="border", align_corners=False)
    return cubemap.raw(sampled[0].movedim(0, -1).reshape(6, resolution, resolution, 3)).float()


@torch.no_grad()
def turned_cubemap(texels: Tensor, turn: Tensor, resolution: int) -> Tensor:
    """Rotate an environment by a rotation matrix [3, 3] in world axes, and return its raw texels [6, R, R, C]."""
    directions = (texel_directions(resolution).double() @ turn).reshape(-1, 3)
    return cubemap_lookup(texels, directions.to(texels)).reshape(6, resolution, resolution, -1)


def write_exr(path: Path, picture: Tensor, attributes: Mapping[str, str] = {}) -> None:
    """Write linear radiance [H, W, 3] as an EXR file of 32-bit floats.

    Args:
        path: the file.
        picture: the radiance.
        attributes: standard attributes of the format, such as ``owner``.

    Raises:
        PolarguideError: OpenEXR is not installed.
    """
    exr = optional_import("OpenEXR", "an EXR file")
    header = {"compression": exr.ZIP_COMPRESSION, "type": exr.scanlineimage, **attributes}
    pixels = np.ascontiguousarray(picture.detach().numpy().astype(np.float32))
    with atomic(path) as temporary, in_utf8(temporary) as name, exr.File(header, {"RGB": pixels}) as file:
        try:
            file.write(str(name))
        except RuntimeError as error:
            raise OSError(str(error).strip().splitlines()[-1]) from None


def write_hdr(path: Path, picture: Tensor) -> None:
    """Write linear radiance [H, W, 3] as Radiance RGBE, with 8 bits per channel and a common exponent.

    More programs read this format than EXR.
    """
    pixels = np.ascontiguousarray(picture.detach().numpy().astype(np.float32)[..., ::-1])
    _, data = cv2.imencode(".hdr", pixels)
    write_whole(path, data.tobytes())


def read_panorama(path: Path) -> Tensor:
    """Read a panorama of linear radiance, Radiance HDR or OpenEXR: [H, W, 3] float32, not negative.

    Raises:
        PolarguideError: the file is missing, has another format or aspect ratio, is black, or contains NaN.
    """
    found = ""
    if not path.is_file():
        found = "no such file"
    elif path.suffix.lower() not in (".hdr", ".exr"):
        found = f"a name that ends in {path.suffix or 'nothing'}"
    else:
        pixels = read_radiance(path)
        if pixels.shape[1] != 2 * pixels.shape[0] or pixels.size > 3 * LARGEST:
            found = f"a picture of shape {list(pixels.shape)}"
    if found:
        raise PolarguideError(
            path,
            expected="a panorama of linear radiance, .hdr or .exr, twice as wide as high",
            found=found,
            remedy="Choose an equirectangular picture.",
        )
    values = torch.tensor(pixels)
    missing = int(values.isnan().any(dim=-1).sum())
    if missing or not bool((values > 0).any()):
        raise PolarguideError(
            path,
            expected="a finite value at every pixel, and at least one value above 0",
            found=f"NaN at {missing} of {values[..., 0].numel()} pixels" if missing else "no value above 0",
            remedy="Export the panorama again, or fill these pixels.",
        )
    return values.clamp(0, 6e4)
