"""Polarization optics: pure functions on tensors of any batch shape, float dtype and device.

They are differentiable, and value and gradient stay finite at every degenerate point (no light, no
polarization, normal and grazing incidence).
"""

from polarguide.optics.analyzers import Mount, analyzer, filter_analyzer, fitted_stokes
from polarguide.optics.chromatic import ChromaticNormals, chromatic_normals
from polarguide.optics.conductor import (
    conductor,
    conductor_dolp_slope,
    conductor_index,
    conductor_reflectances,
)
from polarguide.optics.frames import azimuth, lens_frame, normal_from_angles, zenith
from polarguide.optics.fresnel import (
    brewster,
    diffuse_dolp,
    diffuse_dolp_limit,
    diffuse_zenith,
    dolp_slopes,
    reflectances,
    reflectances_from_cosine,
    specular_dolp,
    specular_zeniths,
    transmittances,
)
from polarguide.optics.normals import (
    Candidates,
    Disambiguated,
    PhysicalCandidates,
    disambiguate,
    dolp_noise,
    intensity_noise,
    paper_candidates,
    physical_candidates,
    polarization_mask,
)
from polarguide.optics.separation import (
    Separation,
    exact_separation,
    paper_intensities,
    paper_separation,
    predicted_stokes,
)
from polarguide.optics.stokes import aolp, dolp, intensity, luminance, photograph, stokes
from polarguide.optics.uncertainty import UNIFORM_SPREAD, Uncertainty, polarization_uncertainty
from polarguide.polarizer import ANGLES

__all__ = [
    "ANGLES",
    "UNIFORM_SPREAD",
    "Candidates",
    "ChromaticNormals",
    "Disambiguated",
    "Mount",
    "PhysicalCandidates",
    "Separation",
    "Uncertainty",
    "analyzer",
    "aolp",
    "azimuth",
    "brewster",
    "chromatic_normals",
    "conductor",
    "conductor_dolp_slope",
    "conductor_index",
    "conductor_reflectances",
    "diffuse_dolp",
    "diffuse_dolp_limit",
    "diffuse_zenith",
    "disambiguate",
    "dolp",
    "dolp_noise",
    "dolp_slopes",
    "exact_separation",
    "filter_analyzer",
    "fitted_stokes",
    "intensity",
    "intensity_noise",
    "lens_frame",
    "luminance",
    "normal_from_angles",
    "paper_candidates",
    "paper_intensities",
    "paper_separation",
    "photograph",
    "physical_candidates",
    "polarization_mask",
    "polarization_uncertainty",
    "predicted_stokes",
    "reflectances",
    "reflectances_from_cosine",
    "specular_dolp",
    "specular_zeniths",
    "stokes",
    "transmittances",
    "zenith",
]
