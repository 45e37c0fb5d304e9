"""The one render result, the same in every stage and recipe, and the layout of the G-buffer that it is made of."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import torch
from torch import Tensor

from polarguide import optics

COLOR_CHANNELS = (0, 1, 2)
NORMAL_CHANNELS = (3, 4, 5)


@dataclass(frozen=True)
class Layout:
    """Names of a G-buffer's channels.

    The order is always color, normal (if splatted), the shading model's channels, and depth (if splatted). The native
    passes rely on it.

    Attributes:
        widths: number of channels of each name, in the order in which they lie.
    """

    widths: Mapping[str, int]

    def __contains__(self, name: str) -> bool:
        return name in self.widths

    def __iter__(self) -> Iterator[str]:
        return iter(self.widths)

    def first(self, name: str) -> int:
        """The first channel of a name; -1 if there is none."""
        begin = 0
        for other, width in self.widths.items():
            if other == name:
                return begin
            begin += width
        return -1

    def channels(self, name: str) -> slice:
        """The channels of a name.

        Raises:
            KeyError: there are none.
        """
        begin = self.first(name)
        return slice(begin, begin + self.widths[name])


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
"""The pictures in a ``RenderResult``, by name."""
POLARIZED = ("stokes", "dolp", "aolp")
"""What a result with ``predicted`` Stokes vectors has besides. What a view's pictures say of the same has these names
with ``, measured``."""


class MetalPixels(NamedTuple):
    """Metals in a picture of P pixels.

    Attributes:
        pixels: [K] int64, those that show metal, ascending.
        share: [K] blended metalness in [0, 1], without a gradient.
        specular: [K, 3] what metals reflect there.
        slope: [K, 3] its degree of polarization over ``sin^2(zenith)``.
    """

    pixels: Tensor
    share: Tensor
    specular: Tensor
    slope: Tensor


@dataclass(frozen=True, eq=False)
class RenderResult:
    """A rendered view: its layers by name, and tensors that training alone reads.

    Radiance is linear, on the scale of S0/2. ``final``, ``base`` and ``alpha`` are always there, ``normal`` and
    ``depth`` where they were requested, the other layers where the shading model has them.

    Attributes:
        layers: by name, [H, W, 3] unless stated otherwise.

            - ``final``: the picture; ``specular + diffuse`` of a model that reflects.
            - ``specular``, ``diffuse``: contributions of reflection and of the base color to the picture.
            - ``base``: blended base color.
            - ``reflection``: the environment along the mirrored ray.
            - ``strength``: [H, W] reflection strength in [0, 1].
            - ``roughness``: [H, W] square root of GGX's alpha, as in glTF; no gradient.
            - ``metalness``: [H, W] share of metals in [0, 1].
            - ``normal``: blended normal in world axes, not normalized. If the surface was requested, the normal around
              the pixel's median depth, see ``raster.surface``.
            - ``depth``: [H, W] expected camera depth over alpha; if the surface was requested, around the median.
            - ``alpha``: [H, W] in [0, 1].
            - ``shaded_normal``: the normal of the shading, where ``normal`` is that of the surface.
            - ``index``: [H, W] refractive index, no gradient, where it is not the run's everywhere.
            - ``stokes``, ``dolp``, ``aolp``: see ``polarized_layers``.

        metal: contribution of metals to ``specular``; None without metals.
        training: tensors that training alone reads, by name.

            - ``radii``: [N] pixels, of the projected Gaussians; 0 where culled.
            - ``detached_specular``, ``detached_diffuse``: the layers without a gradient on the normals.
            - ``rotation_only_normal``: the blended normal with a gradient that rotates Gaussians, but neither moves
              them nor changes their opacity.
    """

    layers: Mapping[str, Tensor]
    metal: MetalPixels | None = None
    training: Mapping[str, Tensor] = field(default_factory=dict)

    @property
    def final(self) -> Tensor:
        """The picture, [H, W, 3]."""
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
        """An optional layer as an attribute: ``result.strength``; None where the rendering does not have it."""
        if name not in LAYERS:
            raise AttributeError(f"RenderResult has no layer {name!r}")
        return self.layers.get(name)

    @property
    def shaded_normal(self) -> Tensor:
        """Normal with which the layers were shaded, [H, W, 3]."""
        return self.layers.get("shaded_normal", self.normal)

    @property
    def is_polarized(self) -> bool:
        """True if both lobes and the normal exist, from which Stokes vectors are predicted."""
        return {"specular", "diffuse", "normal"} <= self.layers.keys()

    def with_layers(self, **layers: Tensor) -> RenderResult:
        """A copy with layers added or replaced."""
        return replace(self, layers={**self.layers, **layers})

    def to(self, device: torch.device | str) -> RenderResult:
        """The layers on a device, without the tensors of training."""
        layers = {name: layer.to(device) for name, layer in self.layers.items()}
        metal = None if self.metal is None else MetalPixels(*(t.to(device) for t in self.metal))
        return RenderResult(layers, metal)


def polarized_layers(stokes: Tensor) -> dict[str, Tensor]:
    """Layers of predicted polarization by the names of ``POLARIZED``.

    Args:
        stokes: [3, H, W, 3] Stokes vectors in the lens frame, as in ``View.stokes``; S0 is twice the picture.

    Returns:
        ``stokes``, and of its luminance the ``dolp`` [H, W] in [0, 1] and the ``aolp`` [H, W] in [0, pi) radians.
    """
    luminance = optics.luminance(stokes)
    return {"stokes": stokes, "dolp": optics.dolp(luminance), "aolp": optics.aolp(luminance)}
