"""Result of a rendering, in the same format for all recipes, and the channels of the G-buffer."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import accumulate
from typing import NamedTuple

import torch
from torch import Tensor

from polarguide import optics

COLOR_CHANNELS = (0, 1, 2)
"""Channels of the base color in a G-buffer."""
NORMAL_CHANNELS = (3, 4, 5)
"""Channels of the normal in a G-buffer with normals."""
ChannelSlices = Mapping[str, slice]
"""Slices of the channels of a G-buffer by name.

The order is color, normal (if splatted), channels of the shading model, and depth (if splatted). The native passes rely
on this order.
"""


def channel_slices(widths: Mapping[str, int]) -> dict[str, slice]:
    """Return the slices of channels by name, from the numbers of channels by name, in order."""
    ends = accumulate(widths.values())
    return {name: slice(end - width, end) for (name, width), end in zip(widths.items(), ends, strict=True)}


def first_channel(channels: ChannelSlices, name: str) -> int:
    """Return the index of the first channel of a name, or -1 if the name has no channels."""
    return channels[name].start if name in channels else -1


LAYERS = (
    "final",
    "base",
    "reflection",
    "specular",
    "diffuse",
    "strength",
    "roughness",
    "metalness",
    "normal",
    "depth",
    "alpha",
)
"""Names of the pictures in a ``RenderResult``."""
POLARIZED = ("stokes", "dolp", "aolp")
"""Names of the layers that a prediction of Stokes vectors adds.

The corresponding layers that were measured in a view have these names followed by ``, measured``.
"""


class MetalPixels(NamedTuple):
    """Pixels of a picture that show metal.

    Attributes:
        pixels: [K] int64 indices of the pixels, ascending.
        share: [K] blended metalness in [0, 1], without a gradient.
        specular: [K, 3] contribution of metals to the specular layer.
        slope: [K, 3] degree of polarization of this contribution over ``sin^2(zenith)``.
    """

    pixels: Tensor
    share: Tensor
    specular: Tensor
    slope: Tensor


@dataclass(frozen=True, eq=False)
class RenderResult:
    """Rendered view: layers by name, and tensors for training.

    Radiance is linear, on the scale of S0/2. Every result has ``final``, ``base`` and ``alpha``. It has ``normal`` and
    ``depth`` if they were requested, and other layers if the shading model has them.

    Attributes:
        layers: by name, [H, W, 3] unless stated otherwise.

            - ``final``: the picture; ``specular + diffuse`` for a model that reflects.
            - ``specular``, ``diffuse``: contributions of reflection and of the base color to the picture.
            - ``base``: blended base color.
            - ``reflection``: the environment along the mirrored ray.
            - ``strength``: [H, W] reflection strength in [0, 1].
            - ``roughness``: [H, W] square root of GGX's alpha, as in glTF; no gradient.
            - ``metalness``: [H, W] share of metals in [0, 1].
            - ``reflectance``: reflectance of metals at normal incidence, no gradient; only if there are metals.
            - ``normal``: blended normal in world axes, not normalized. If the surface was requested, the normal around
              the pixel's median depth, see ``raster.surface``.
            - ``depth``: [H, W] expected camera depth over alpha; around the median if the surface was requested.
            - ``alpha``: [H, W] in [0, 1].
            - ``shaded_normal``: the normal of the shading, if ``normal`` is the normal of the surface.
            - ``index``: [H, W] refractive index, no gradient; only if Gaussians have several.
            - ``stokes``, ``dolp``, ``aolp``: see ``polarized_layers``.

        metal: contribution of metals to ``specular``; None without metals.
        training: tensors for training by name.

            - ``radii``: [N] radii of the projected Gaussians in pixels; 0 if culled.
            - ``detached_specular``, ``detached_diffuse``: the layers without a gradient on the normals.
            - ``rotation_only_normal``: the blended normal. Its gradient rotates Gaussians and leaves their
              position and opacity unchanged.
    """

    layers: Mapping[str, Tensor]
    metal: MetalPixels | None = None
    training: Mapping[str, Tensor] = field(default_factory=dict)

    @property
    def final(self) -> Tensor:
        """Picture, [H, W, 3]."""
        return self.layers["final"]

    @property
    def base(self) -> Tensor:
        """Blended base color, [H, W, 3]."""
        return self.layers["base"]

    @property
    def alpha(self) -> Tensor:
        """Blended opacity, [H, W]."""
        return self.layers["alpha"]

    @property
    def normal(self) -> Tensor:
        """Normal of a rendering that requested it, [H, W, 3]."""
        return self.layers["normal"]

    @property
    def depth(self) -> Tensor:
        """Camera depth of a rendering that requested it, [H, W]."""
        return self.layers["depth"]

    def __getattr__(self, name: str) -> Tensor | None:
        """Return an optional layer, such as ``result.strength``, or None if the rendering lacks it."""
        if name not in LAYERS:
            raise AttributeError(f"RenderResult has no layer {name!r}")
        return self.layers.get(name)

    @property
    def shaded_normal(self) -> Tensor:
        """Normal with which the layers were shaded, [H, W, 3]."""
        return self.layers.get("shaded_normal", self.normal)

    @property
    def is_polarized(self) -> bool:
        """True if the result has specular and diffuse layer and normal, from which Stokes vectors are predicted."""
        return {"specular", "diffuse", "normal"} <= self.layers.keys()

    def with_layers(self, **layers: Tensor) -> RenderResult:
        """Return a copy with layers added or replaced."""
        return replace(self, layers={**self.layers, **layers})

    def to(self, device: torch.device | str) -> RenderResult:
        """Return the layers on a device, without the tensors for training."""
        layers = {name: layer.to(device) for name, layer in self.layers.items()}
        metal = None if self.metal is None else MetalPixels(*(t.to(device) for t in self.metal))
        return RenderResult(layers, metal)


def polarized_layers(stokes: Tensor) -> dict[str, Tensor]:
    """Return layers of predicted polarization by the names of ``POLARIZED``.

    Args:
        stokes: [3, H, W, 3] Stokes vectors in the lens frame, as in ``View.stokes``; S0 is twice the picture.

    Returns:
        The layers ``stokes``, ``dolp`` [H, W] in [0, 1], and ``aolp`` [H, W] in [0, pi) radians. The latter two are
        computed from the luminance.
    """
    luminance = optics.luminance(stokes)
    return {"stokes": stokes, "dolp": optics.dolp(luminance), "aolp": optics.aolp(luminance)}
