"""Recipes are data: a list of stages, each saying what is rendered, what is compared, and what happens when.

Nothing in the loop compares a step with a constant: boundaries are fractions of the total number of steps.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from polarguide.gaussians.densify import Densification
from polarguide.gaussians.initialize import Initialization
from polarguide.shading.deferred import Blend, Shading
from polarguide.shading.directional import DirectionalShading
from polarguide.shading.model import ShadingModel

Action = Literal["reset_opacity", "propagate_normals", "refresh_priors", "orient_normals"]
Candidates = Literal["paper", "physical"]
Separation = Literal["paper", "exact"]


@dataclass(frozen=True)
class Repeat:
    """Something that happens every so often.

    Attributes:
        action: what.
        fraction: of all steps, the distance between two of them.
        minimum: never closer than this many steps.
    """

    action: Action
    fraction: float
    minimum: int = 1


@dataclass(frozen=True)
class Weights:
    """Weights of the loss terms; a term with weight 0 is not computed.

    Attributes:
        photometric: final picture against S0/2.
        specular, diffuse: the two contributions against the separated pictures.
        normal: 1 - cosine with the disambiguated polarization normal (azimuth and zenith).
        azimuth: distance of the normal from the plane of incidence that the AoLP names (azimuth alone).
        chromatic: 1 - cosine with the normal that color differences tell, where they do.
        stokes: S1 and S2 that the layers and the normal predict against the measured ones.
        flatness: shortest scale of the Gaussians, in percent of the scene's extent.
        consistency: alpha - cosine of the blended normal with that of the rendered depth.
    """

    photometric: float = 1.0
    specular: float = 0.0
    diffuse: float = 0.0
    normal: float = 0.0
    azimuth: float = 0.0
    chromatic: float = 0.0
    stokes: float = 0.0
    flatness: float = 0.0
    consistency: float = 0.0

    @property
    def priors(self) -> bool:
        """Whether a term compares with the priors of a view."""
        layers = self.specular, self.diffuse, self.stokes
        return any((*layers, self.normal, self.azimuth, self.chromatic))

    @property
    def normals(self) -> bool:
        """Whether a term looks at the rendered normals."""
        return any((self.normal, self.azimuth, self.chromatic, self.stokes, self.consistency))


@dataclass(frozen=True)
class Stage:
    """One phase of training.

    Attributes:
        name: shown while it runs.
        fraction: its share of all steps.
        reflection: whether the picture is shaded with deferred reflection.
        weights: of the losses.
        densify: whether the density control runs.
        repeats: what happens every so often in it.
        on_enter: what happens at its first step.
        rate_factors: on the recipe's learning rates while it lasts, by name; 1 where not named.
    """

    name: str
    fraction: float
    reflection: bool
    weights: Weights = field(default_factory=Weights)
    densify: bool = False
    repeats: tuple[Repeat, ...] = ()
    on_enter: tuple[Action, ...] = ()
    rate_factors: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Priors:
    """How polarization priors are computed from the frozen Gaussians.

    Attributes:
        candidates: which polarization normals are considered.
        separation: which separation supervises the layers.
        threshold: DoLP above which a pixel's normal is used.
        full_dolp: DoLP from which on a pixel's normal counts fully; below, in proportion.
        azimuth_weight: in [0, 1], how much the choice among candidates trusts azimuth over zenith.
        snr: ratio of the DoLP to its noise above which a pixel's normal is used; 0 switches the test off.
        chromatic: whether the polarization of color differences names the plane where it is decided.
    """

    candidates: Candidates = "physical"
    separation: Separation = "exact"
    threshold: float = 0.05
    full_dolp: float = 0.3
    azimuth_weight: float = 0.5
    snr: float = 0.0
    chromatic: bool = False


@dataclass(frozen=True)
class Propagation:
    """Normal propagation of 3DGS-DR (Ye et al. 2024, Sec. 3.3).

    Attributes:
        opacity: opacities are raised to at least this.
        color_noise: half-width of the noise on the base color where strength is at most ``matte``.
        matte, glossy: strengths that bound the two kinds of Gaussian.
        widen: factor on the two longer scales where strength is at least ``glossy``.
    """

    opacity: float = 0.9
    color_noise: float = 0.4
    matte: float = 0.05
    glossy: float = 0.02
    widen: float = 1.5


@dataclass(frozen=True)
class Recipe:
    """All that tells one method from another.

    Attributes:
        name: as given to ``--recipe``.
        about: one line.
        stages: in order; their fractions add up to 1.
        rates: learning rates; that of the means is times the scene's extent.
        means_decay: factor on the means' rate at the last step (exponential in between).
        blend: how base color and reflection make the picture (see ``Shading``).
        oriented: whether normals keep the side from which training views see them ("orient_normals" finds it).
        local: whether Gaussians add reflected light of their own (see ``Shading``).
        directional: the shading model in place of ``Shading``, if given; ``environment_*`` then tell its grid.
        first_strength: reflection strength that Gaussians start with.
        environment_spread: first raw texels are uniform in plus or minus this.
        environment_rate: learning rate of the environment's texels.
        environment_resolution: texels along a cube face's side.
        sh_fractions: shares of all steps at which SH degrees 1, 2 and 3 begin.
        ssim_weight: lambda in (1 - lambda) L1 + lambda (1 - SSIM).
    """

    name: str
    about: str
    stages: tuple[Stage, ...]
    rates: dict[str, float]
    means_decay: float = 0.01
    blend: Blend = "lerp"
    local: bool = False
    oriented: bool = False
    directional: DirectionalShading | None = None
    first_strength: float = 1e-3
    environment_spread: float = 5.0
    environment_rate: float = 0.05
    environment_resolution: int = 128
    sh_fractions: tuple[float, float, float] = (1 / 30, 2 / 30, 3 / 30)
    ssim_weight: float = 0.2
    densification: Densification = field(default_factory=Densification)
    initialization: Initialization = field(default_factory=Initialization)
    priors: Priors = field(default_factory=Priors)
    propagation: Propagation = field(default_factory=Propagation)

    def shading(self, index: float) -> ShadingModel:
        """The shading of this recipe for surfaces of a refractive index."""
        return self.directional or Shading(self.blend, index, self.local)

    @property
    def environment_rates(self) -> dict[str, float]:
        """Learning rates of the environment's parameters by name."""
        rate = self.environment_rate
        return self.directional.rates(rate) if self.directional else {"texels": rate}

    @property
    def reflects(self) -> bool:
        """Whether any stage has reflection (then Gaussians carry what its shading needs)."""
        return any(stage.reflection for stage in self.stages)
