"""``read_shot``: the maps of one exposure set."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence

import numpy as np
import torch

from polarguide import optics
from polarguide.capture.view import View
from polarguide.errors import PolarguideError
from polarguide.shots.develop import Developed, develop, develop_view
from polarguide.shots.exposures import ExposureSet, find_shots
from polarguide.shots.maps import Reason, ShotMaps
from polarguide.shots.options import ShotOptions

UNREADABLE = (PolarguideError, OSError, MemoryError)
"""What one bad file may raise; others come after it."""
_TILE = 1 << 18
"""Pixels that are worked on at a time, so that what is between stays in the processor's cache."""
_DARK_SNR = 3.0
"""S0 in units of its noise from which on there is light."""


def read_shot(
    shot: ExposureSet | View | str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    options: ShotOptions | None = None,
) -> ShotMaps:
    """Read one exposure set: S0, DoLP, AoLP, their standard deviations, and which pixels say nothing.

    Args:
        shot: of ``find_shots``; a view of a scene; or the path of a mosaic, the four paths of shots through a filter,
            or a folder with one shot.
        options: how to read it.

    Raises:
        PolarguideError: it is not one shot, or a file is missing, cannot be read, or does not fit.
    """
    options = (options or ShotOptions()).checked()
    if isinstance(shot, View):
        return maps_of(ExposureSet(shot.name, "scene", {}), develop_view(shot, options), options)
    if not isinstance(shot, ExposureSet):
        paths = [shot] if isinstance(shot, str | os.PathLike) else list(shot)
        found = find_shots(paths, options)
        if len(found) != 1:
            raise PolarguideError(
                paths[0],
                expected="one shot",
                found=f"{len(found)}",
                remedy="find_shots lists them; read them one by one.",
            )
        shot = found[0]
    developed = develop(shot, options)
    return maps_of(shot, developed, options)


def fault_of(shot: ExposureSet, error: BaseException) -> PolarguideError:
    """One of ``UNREADABLE`` as an error that names the shot."""
    if isinstance(error, PolarguideError):
        return error
    if isinstance(error, OSError):
        found, remedy = error.strerror or str(error), "Check the files and their disk."
    else:
        found, remedy = "it needs more memory than there is", "Free memory, or take a smaller region."
    expected = "a shot that can be read, and room for its maps"
    return PolarguideError(shot.paths[0], expected=expected, found=found, remedy=remedy)


def tiles(height: int, width: int) -> Iterator[slice]:
    """Rows of a picture to work on at a time; each starts with a whole superpixel."""
    rows = max(1, _TILE // width // 4) * 4
    for top in range(0, height, rows):
        yield slice(top, min(top + rows, height))


@torch.no_grad()
def maps_of(shot: ExposureSet, developed: Developed, options: ShotOptions) -> ShotMaps:
    """The maps of developed intensities."""
    _, height, width, _ = developed.intensities.shape
    stokes = torch.empty((3, height, width))
    dolp, debiased, aolp, sigma_dolp, sigma_aolp = (torch.empty((height, width)) for _ in range(5))
    reason = torch.zeros((height, width), dtype=torch.uint8)
    factors = torch.from_numpy(np.ascontiguousarray(developed.factors))
    period = factors.shape[1]
    floor, slope = developed.noise.floor, developed.noise.slope
    pattern: torch.Tensor | None = None
    for part in tiles(height, width):
        samples = torch.from_numpy(developed.intensities[:, part])
        gray = samples[..., 0] if samples.shape[-1] == 1 else samples.mean(dim=-1)
        count = gray.shape[1]
        if pattern is None:
            pattern = factors.repeat(1, -(-count // period), -(-width // period))[..., :width].contiguous()
        variances = gray.clamp(min=0).mul_(slope).add_(floor).mul_(pattern[:, :count])
        stokes[:, part] = s = optics.stokes(gray)
        dolp[part] = degree = optics.dolp(s)
        aolp[part] = optics.aolp(s)
        spread = optics.polarization_uncertainty(s, variances)
        sigma_dolp[part], sigma_aolp[part], debiased[part] = spread.dolp, spread.aolp, spread.debiased
        # Later reasons replace earlier ones.
        why = reason[part]
        why[degree <= options.snr * spread.dolp] = Reason.NOISE
        why[s[0] <= _DARK_SNR / 2 * variances.sum(dim=0).sqrt()] = Reason.DARK
    found = reason.numpy()
    for mask, kind in (
        (developed.dark, Reason.DARK),
        (developed.saturated, Reason.SATURATED),
        (developed.masked, Reason.MASKED),
    ):
        found[mask] = kind
    return ShotMaps(
        name=shot.name,
        files=shot.paths,
        intensities=developed.intensities,
        stokes=stokes.numpy(),
        dolp=dolp.numpy(),
        dolp_debiased=debiased.numpy(),
        aolp=aolp.numpy(),
        sigma_dolp=sigma_dolp.numpy(),
        sigma_aolp=sigma_aolp.numpy(),
        reason=found,
        noise=developed.noise,
        pair_ratio=developed.pair_ratio,
        notes=developed.notes,
    )
