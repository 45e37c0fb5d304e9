"""Read a shot from files or arrays (``read_shot``), and compute its normals and layers (``surface_maps``)."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeGuard

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from polarguide import optics
from polarguide.capture import checks
from polarguide.capture.brackets import SINGLE, Bracket, bracket_notes
from polarguide.capture.calibration import UNIT_GAINS, apply_orientation, as_displayed, oriented, pair_ratio
from polarguide.capture.colmap.model import fit_camera, read_model
from polarguide.capture.develop import BracketedShots, LinearShots, moved_shots, pair_gains
from polarguide.capture.exposures import FOUR, Angle, normalized
from polarguide.capture.filter.encoding import transfer_of_pictures
from polarguide.capture.filter.shots import _READ, require_four_shots, stacked
from polarguide.capture.layout import (
    KEPT,
    READ,
    all_exposures,
    find_layout,
    require_memory_of_each,
    select_views,
)
from polarguide.capture.sensor.demosaic import DEMOSAIC_MODES, defects, defects_note, demosaic, spoiled
from polarguide.capture.sensor.mosaics import MosaicFiles, calibration_of, sample_blocks
from polarguide.capture.sensor.pattern import (
    SIDE,
    Levels,
    require_kind,
)
from polarguide.capture.view import ANGLES, FULL_CODE, View
from polarguide.capture.view_reader import (
    Array,
    ViewData,
    as_numpy,
    exposures_of,
    kind_of,
    read_view,
    stored_pictures,
)
from polarguide.core.errors import PolarguideError, require
from polarguide.core.files import require_file
from polarguide.core.options import check_finite, index_of
from polarguide.core.text import decimals
from polarguide.geometry.camera import Camera
from polarguide_shots.exposures import find_shots
from polarguide_shots.fit import DARK_SNR, maps_of_set
from polarguide_shots.maps import (
    Developed,
    Map,
    Mask,
    Part,
    Reason,
    ShotMaps,
    estimated_noise,
    given_noise,
    interpolation_factors,
)
from polarguide_shots.options import ShotOptions
from polarguide_shots.samples import (
    SetSamples,
    behind_lens,
    levels_of_shot,
    read_set,
    samples_of_arrays,
    samples_of_loaded,
    samples_of_view,
    state_of,
    stated_of_shot,
)
from polarguide_shots.sets import ExposureSet, require_determined

UNREADABLE = (PolarguideError, OSError, MemoryError)
"""Exception types that mark one shot as unreadable, while the remaining shots are still processed."""
_TILE = 1 << 18
"""Batch size in pixels. Intermediate results of a batch fit into the processor's cache."""


def read_shot(
    shot: ExposureSet
    | View
    | Array
    | str
    | os.PathLike[str]
    | Sequence[str | os.PathLike[str]]
    | Sequence[Array],
    options: ShotOptions | None = None,
    angles: Sequence[Angle] = ANGLES,
    part: Part | None = None,
) -> ShotMaps:
    """Read one shot, and compute S0, DoLP, AoLP, their standard deviations, and the reasons to reject pixels.

    The argument ``shot`` can be:

    - a result of ``find_shots``, or a view of a scene
    - the path of a mosaic, of a video with its table, or of a folder with one shot
    - the paths of pictures through a filter at three or more angles
    - a raw mosaic [H, W] of uint8 or uint16 in NumPy or torch, if ``options.sensor`` names the sensor
    - pictures through a filter, as an array [K, H, W] or [K, H, W, 3] RGB, or as a list of K arrays. Integers are
      stored values. Floats are linear, from 0 to 1.

    Args:
        shot: the shot.
        options: options of reading.
        angles: angles of the K pictures of an array, in degrees counter-clockwise as displayed. Files state their own
            angles.
        part: requested part of the picture of a mosaic. The remaining pixels are skipped if that saves time;
            ``ShotMaps.origin`` and ``ShotMaps.whole`` describe the result. The noise is then estimated from the part
            unless the options state it.

    Raises:
        PolarguideError: the path does not contain exactly one shot, a file is missing or cannot be read, the files do
            not fit each other, or an array has an invalid shape or type.
    """
    options = (options or ShotOptions()).checked()
    if isinstance(shot, View):
        if shot.exposures != FOUR:
            return maps_of_set(shot.name, (), samples_of_loaded(shot), options)
        dark, saturated, step = state_of(shot)
        developed = _undistorted(
            behind_lens(shot, shot.intensities(), FOUR).numpy(),
            dark,
            saturated,
            shot.invalid.numpy(),
            None if shot.mask is None else shot.mask.numpy(),
            step,
            options,
        )
        return maps_of(ExposureSet(shot.name, "scene", {}), developed, options)
    if is_array(shot):
        shot = array_shot(stacked_array(shot), options, angles)
    elif not isinstance(shot, ExposureSet):
        paths = [shot] if isinstance(shot, str | os.PathLike) else list(shot)
        shots = find_shots(paths, options)
        require(
            len(shots) == 1,
            paths[0],
            expected="one shot",
            found=f"{len(shots)}",
            remedy="Find the shots with find_shots, and read each separately.",
        )
        shot = shots[0]
    if shot.fault is not None:
        raise shot.fault
    options.require_kind(shot.kind, shot.name)
    samples = set_samples(shot, options)
    if samples is not None:
        return maps_of_set(shot.name, shot.paths, samples, options)
    return maps_of(shot, develop(shot, options, part), options)


def fault_of(shot: ExposureSet, error: BaseException) -> PolarguideError:
    """Convert an exception of a type in ``UNREADABLE`` to an error that names the shot."""
    if isinstance(error, PolarguideError):
        return error
    found = "too little free memory"
    remedy = "Free memory, or select a smaller region."
    if isinstance(error, OSError):
        found = error.strerror or str(error)
        remedy = "Check the files and their disk."
    return PolarguideError(
        shot.where,
        expected="a readable shot, and memory and disk space for its maps",
        found=found,
        remedy=remedy,
    )


def tiles(height: int, width: int) -> Iterator[slice]:
    """Split the rows of a picture into batches that start at the first row of a superpixel."""
    rows = max(1, _TILE // width // 4) * 4
    for top in range(0, height, rows):
        yield slice(top, min(top + rows, height))


@torch.no_grad()
def maps_of(shot: ExposureSet, developed: Developed, options: ShotOptions) -> ShotMaps:
    """Compute the polarization maps of a shot from its developed intensities.

    Args:
        shot: name and files of the shot.
        developed: developed intensities of the shot.
        options: options of reading.
    """
    _, height, width, _ = developed.intensities.shape
    stokes = torch.empty((3, height, width))
    maps: dict[str, Any] = {
        key: torch.empty((height, width))
        for key in ("dolp", "dolp_debiased", "aolp", "sigma_dolp", "sigma_aolp")
    }
    reason = torch.zeros((height, width), dtype=torch.uint8)
    factors = torch.from_numpy(np.ascontiguousarray(developed.factors))
    period = factors.shape[1]
    pattern: torch.Tensor | None = None
    for part in tiles(height, width):
        samples = torch.from_numpy(developed.intensities[:, part])
        gray = samples[..., 0] if samples.shape[-1] == 1 else samples.mean(dim=-1)
        count = gray.shape[1]
        if pattern is None:
            pattern = factors.repeat(1, -(-count // period), -(-width // period))[..., :width].contiguous()
        variances = gray.clamp(min=0).mul_(developed.noise.slope).add_(developed.noise.floor)
        variances.mul_(pattern[:, :count])
        s = optics.stokes(gray)
        degree = optics.dolp(s)
        spread = optics.polarization_uncertainty(s, variances)
        stokes[:, part] = s
        values = (degree, spread.debiased, optics.aolp(s), spread.dolp, spread.aolp)
        for tensor, value in zip(maps.values(), values, strict=True):
            tensor[part] = value
        # Later reasons replace earlier reasons.
        reason[part][degree <= options.snr * spread.dolp] = Reason.NOISE
        reason[part][s[0] <= DARK_SNR / 2 * variances.sum(dim=0).sqrt()] = Reason.DARK
    codes = reason.numpy()
    codes[developed.dark] = Reason.DARK
    codes[developed.saturated] = Reason.SATURATED
    codes[developed.masked] = Reason.MASKED
    return ShotMaps(
        name=shot.name,
        files=shot.paths,
        intensities=developed.intensities,
        stokes=stokes.numpy(),
        **{key: tensor.numpy() for key, tensor in maps.items()},
        reason=codes,
        noise=developed.noise,
        pair_ratio=developed.pair_ratio,
        notes=developed.notes,
        pixel_variance=float(developed.factors.mean()),
        mean_variance=developed.mean_variance,
        origin=developed.origin,
        whole=developed.whole,
    )


TOWARD = (0.0, -0.5, -1.0)
"""Direction in camera axes that normals are expected to have: toward the camera, and a little upward."""


@dataclass(frozen=True, eq=False)
class SurfaceMaps:
    """Normals, and layers of specular and diffuse light, that a shot suggests for a smooth dielectric surface.

    The computation assumes unpolarized illumination.

    Attributes:
        zeniths: [3, H, W] float32, radians. The three zeniths have the DoLP of the pixel: the first for diffuse light,
            the second and third for specular light below and above Brewster's angle. The normal has six candidates:
            azimuth AoLP and AoLP + pi for diffuse light, AoLP + pi/2 and AoLP - pi/2 for specular light. The diffuse
            zenith is NaN if diffuse light cannot have the DoLP.
        normal: [H, W, 3] float32 in camera axes (x right, y down, z forward). It is the candidate nearest to
            ``TOWARD``, which is a guess. Pixels without a valid angle have 0.
        specular_paper: [H, W, C] float32 in units of S0, specular layer of the coarse separation of PolarGuide-GSDR. It
            needs no normal and uses the diffuse zenith of the DoLP.
        diffuse_paper: [H, W, C] float32 in units of S0, diffuse layer of the coarse separation. The two coarse layers
            do not add up to S0.
        specular_exact: [H, W, C] float32 in units of S0, specular layer by Fresnel's equations. It depends on the
            guessed normal.
        diffuse_exact: [H, W, C] float32 in units of S0, diffuse layer by Fresnel's equations. The two exact layers add
            up to S0.
        conditioned: mask [H, W] of pixels at which the exact separation is well conditioned.
        refractive_index: refractive index of all surfaces.
        perspective: True if the rays of the pixels are known, False if they are assumed to be parallel to the axis.
    """

    zeniths: Map
    normal: Map
    specular_paper: Map
    diffuse_paper: Map
    specular_exact: Map
    diffuse_exact: Map
    conditioned: NDArray[np.bool_]
    refractive_index: float
    perspective: bool


def parse_intrinsics(text: str, size: tuple[int, int]) -> Camera:
    """Parse the intrinsics ``fx,fy,cx,cy``, in pixels of a picture of ``size`` (width, height).

    Raises:
        PolarguideError: the text is invalid.
    """
    numbers = decimals(text)
    # The center may be outside of a cropped picture. Beyond these bounds it is a typo.
    centered = all(abs(c - n / 2) <= 10 * n for c, n in zip(numbers[2:], size, strict=False))
    if len(numbers) != 4 or not centered or not all(0 < f <= 1e6 for f in numbers[:2]):
        raise PolarguideError(
            "--intrinsics",
            expected="fx,fy,cx,cy in pixels of the developed picture",
            found=repr(text),
            remedy="Give four numbers; the center of the first pixel is at 0.5.",
        )
    return Camera(*size, *numbers, torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64))


def camera_of(shot: ExposureSet, size: tuple[int, int], intrinsics: str | None) -> Camera | None:
    """Return the camera of a shot from ``intrinsics``, or else from the poses of its scene.

    Return None if there are no intrinsics and no poses.

    Raises:
        PolarguideError: the intrinsics or the COLMAP model are invalid.
    """
    if intrinsics is not None:
        return parse_intrinsics(intrinsics, size)
    if shot.root is None or not (shot.root / "sparse").exists():
        return None
    model = read_model(shot.root)
    if shot.view not in model.names:
        return None
    return fit_camera(model.camera(shot.view), *size, folder=model.folder, view=shot.view)


@torch.no_grad()
def surface_maps(
    maps: ShotMaps, camera: Camera | None = None, refractive_index: float | None = None
) -> SurfaceMaps:
    """Compute the candidates of the normals, choose one of them, and separate specular and diffuse light.

    Args:
        maps: maps of the shot.
        camera: camera of the pixels. If None, rays are assumed to be parallel to the axis, which nearly holds for a
            long lens.
        refractive_index: refractive index of all surfaces. If None, the default index is used.

    Raises:
        PolarguideError: the refractive index is out of range.
    """
    refractive_index = index_of(refractive_index)
    check_finite("refractive_index", refractive_index, 1.0001, 4.0)
    channels, height, width = maps.intensities.shape[3], *maps.reason.shape
    zeniths = torch.empty((3, height, width))
    conditioned = torch.empty((height, width), dtype=torch.bool)
    names = ("specular_paper", "diffuse_paper", "specular_exact", "diffuse_exact")
    depths = {"normal": 3, **{name: int(channels) for name in names}}
    layers = {key: torch.empty((depth, height, width)).movedim(0, -1) for key, depth in depths.items()}
    stokes = torch.from_numpy(maps.stokes)
    dolp = torch.from_numpy(maps.dolp)
    for part in tiles(height, width):
        rays = torch.tensor([0.0, 0.0, 1.0]) if camera is None else camera.rays()[part]
        s = optics.stokes(torch.from_numpy(maps.intensities[:, part]))
        candidates = optics.physical_candidates(stokes[:, part], rays, refractive_index)
        normal = optics.disambiguate(candidates, torch.tensor(TOWARD)).normal
        zeniths[0, part] = optics.diffuse_zenith(dolp[part], refractive_index)
        zeniths[1, part], zeniths[2, part] = optics.specular_zeniths(dolp[part], refractive_index)
        paper = optics.paper_separation(s, zeniths[0, part], refractive_index)
        exact = optics.exact_separation(s, normal, rays, refractive_index)
        conditioned[part] = exact.conditioned
        normal = normal * torch.from_numpy(maps.usable[part])[..., None]
        values = (normal, paper.specular, paper.diffuse, exact.specular, exact.diffuse)
        for layer, value in zip(layers.values(), values, strict=True):
            layer[part] = value
    zeniths[0][dolp > optics.diffuse_dolp_limit(refractive_index)] = math.nan
    return SurfaceMaps(
        zeniths=zeniths.numpy(),
        **{key: layer.numpy() for key, layer in layers.items()},
        conditioned=conditioned.numpy(),
        refractive_index=refractive_index,
        perspective=camera is not None,
    )


NAME = "array"
"""Default name of a shot in memory."""


def array_shot(
    array: Array, options: ShotOptions, angles: Sequence[Angle] = ANGLES, name: str = NAME
) -> ExposureSet:
    """Create a shot in memory. The array is not modified.

    Args:
        array: a raw mosaic [H, W] of uint8 or uint16 if the options name a sensor. Otherwise pictures through a filter,
            [K, H, W] gray or [K, H, W, 3] RGB: uint8 or uint16 as stored, or linear floats from 0 to 1.
        options: options of reading.
        angles: angles of the K pictures in degrees, counter-clockwise as displayed.
        name: name of the shot, which error messages show.

    Raises:
        PolarguideError: shape, type or angles are invalid.
    """
    values = as_numpy(array)
    if options.sensor is not None:
        return ExposureSet(name, "mosaic", {}, stored=_mosaic(values, options, name))
    require(
        values.ndim != 2,
        name,
        expected="pictures [K, H, W] or [K, H, W, 3] through a filter, or a sensor of the mosaic",
        found=kind_of(values),
        remedy="Name the sensor of a mosaic: ShotOptions(sensor=...); stack the pictures of a filter, [K, H, W].",
    )
    require(
        not np.issubdtype(values.dtype, np.floating) or options.transfer != "srgb",
        name,
        expected="integers with srgb=True",
        found=kind_of(values),
        remedy="Remove srgb=True, because floats are linear.",
    )
    stored = stored_pictures(values, name)
    exposures_of(angles, len(stored), f"{name} (angles)")
    known = [angle if isinstance(angle, str) else normalized(float(angle)) for angle in angles]
    if sorted(map(str, known)) == sorted(str(float(angle)) for angle in ANGLES):
        order = [known.index(float(angle)) for angle in ANGLES]
        return ExposureSet(name, "filter", {}, stored=stored[order], angles=tuple(map(float, ANGLES)))
    require_determined(f"{name} (angles)", known)
    return ExposureSet(name, "set", {}, stored=stored, angles=tuple(known))


def is_array(shot: object) -> TypeGuard[Array | Sequence[Array]]:
    """Return True for an array or a list of arrays."""
    return isinstance(shot[0] if isinstance(shot, list | tuple) and shot else shot, np.ndarray | Tensor)


def stacked_array(shot: Array | Sequence[Array], name: str = NAME) -> Array:
    """Stack a list of pictures to one array. An array is returned unchanged.

    Raises:
        PolarguideError: the pictures of the list differ in shape or type.
    """
    if not isinstance(shot, list | tuple):
        return shot  # type: ignore[return-value]
    pictures = [as_numpy(picture) for picture in shot]
    kinds = list(dict.fromkeys(map(kind_of, pictures)))
    require(
        len(kinds) <= 1,
        name,
        expected="pictures of one shape and type",
        found=" and ".join(kinds),
        remedy="Export all pictures of a shot with the same settings.",
    )
    return np.stack(pictures)


def _mosaic(values: NDArray[Any], options: ShotOptions, name: str) -> NDArray[Any]:
    """Validate a raw mosaic in memory, and return it as [H, W].

    Raises:
        PolarguideError: shape or type are invalid.
    """
    if values.ndim == 3 and values.shape[2] == 1:
        values = values[..., 0]
    require(
        values.ndim == 2 and values.dtype in (np.uint8, np.uint16) and 0 not in values.shape,
        name,
        expected="a mosaic [H, W] of uint8 or uint16, as required by --sensor (ShotOptions.sensor)",
        found=kind_of(values),
        remedy="Give the values of the sensor before any demosaicing; without a sensor, pictures [K, H, W].",
    )
    height, width = values.shape
    size = options.width or width, options.height or height
    require(
        size == (width, height),
        name,
        expected=f"{size[0]}x{size[1]} pixels according to width and height",
        found=f"{width}x{height}",
        remedy="Remove width and height, because the array has a size of its own.",
    )
    return np.ascontiguousarray(values)


AROUND = 32
"""Margin in samples around a requested part of a mosaic, larger than the reach of any interpolation."""


_GAINS = {
    "off": "I0 + I90 is {:+.2%} off I45 + I135: the angles or the encoding are probably wrong.",
    "corrected": "I0 + I90 is {:+.2%} off I45 + I135; corrected.",
    "left": "I0 + I90 is {:+.2%} off I45 + I135; not corrected (--gains auto does, a calibration does better).",
}
"""Notes for the user on unequal sums I0 + I90 and I45 + I135, by the setting of the gains."""


def develop_mosaic(shot: ExposureSet, options: ShotOptions, part: Part | None) -> Developed:
    """Develop a raw mosaic, or only the requested part if that saves time.

    Levels and gains are always measured in the whole mosaic.

    Raises:
        PolarguideError: the file or an option is invalid.
    """
    files = MosaicFiles(options)
    bracket, exposures = _mosaic_exposures(files, shot)
    stored = exposures[0]
    pattern = files.pattern
    dark = files.dark(stored.shape)
    container = 8 * stored.dtype.itemsize
    full = None
    if shot.stored is None:
        container, full = files.depth(shot.files[0], stored)
    levels, notes = levels_of_shot(
        np.stack(exposures), container, options, bits=options.bits, black=options.black_level, stated=full
    )
    exposures = [files.cut(each) for each in exposures]
    values = exposures[bracket.normal]
    levels = replace(levels, gamma=options.gamma)
    assert options.sensor is not None
    require_kind(options.sensor, sample_blocks(values, SIDE), levels)
    ratio = files.ratio_of_blocks([sample_blocks(values, 2 * pattern.period)], levels, dark, values.shape)
    gains, gain_notes = pair_gains(ratio, options, _GAINS, calibrated=files.analyzers is not None)
    mode = options.demosaic
    step = DEMOSAIC_MODES[mode]
    x, y = files.corner
    cut = _cut(part, values.shape, step)
    whole = None
    if cut is not None:
        whole = (values.shape[1] // step, values.shape[0] // step)
        values = np.ascontiguousarray(values[cut])
        x += cut[1].start
        y += cut[0].start
    radiance, black = files.merged(bracket, exposures, levels, dark, cut)
    notes += [] if bracket.single else bracket_notes([radiance.exposures])
    defective = defects([np.minimum(values, levels.white)], pattern.period)
    notes += [defects_note(int(defective.sum()), values.size)] if defective.any() else []
    linear, masks = files.calibrated(radiance.values, radiance.clipped, black, defective, corner=(x, y))
    saturated, black, defective = masks
    if gains != UNIT_GAINS:
        linear *= files.sample_factors(linear.shape, gains)
    lsb = 1 / (levels.white - levels.black)
    noise = given_noise(options, lsb)
    if noise is None:
        cells = {int(pattern.angles[r, c]): linear[r::2, c::2] for r, c in np.ndindex(2, 2)}
        bad = saturated | black | defective
        good = ~(bad[::2, ::2] | bad[1::2, ::2] | bad[::2, 1::2] | bad[1::2, 1::2])
        noise = estimated_noise([cells[angle] for angle in ANGLES], good, lsb)
    picture = demosaic(linear, saturated, pattern, mode=mode, colored=False)
    factors, mean_variance = interpolation_factors(options.sensor, x, y, mode)
    # A rotation that is not a permutation mixes all four angles.
    mixed = np.broadcast_to(factors.mean(axis=0), factors.shape)
    return Developed(
        intensities=oriented(picture.intensities, options.calibration),
        dark=spoiled(black, pattern, mode=mode),
        saturated=picture.invalid,
        masked=spoiled(defective, pattern, mode=mode),
        noise=noise,
        factors=oriented(factors, options.calibration) if options.calibration.permutes else mixed,
        mean_variance=mean_variance,
        pair_ratio=ratio,
        notes=(*notes, *gain_notes),
        origin=(0, 0) if cut is None else (cut[1].start // step, cut[0].start // step),
        whole=whole,
    )


def _mosaic_exposures(files: MosaicFiles, shot: ExposureSet) -> tuple[Bracket, list[NDArray[Any]]]:
    """Read the stored values [H, W] of all exposures of a mosaic.

    Raises:
        PolarguideError: a file is invalid, or its size or type differs from the first one.
    """
    if shot.stored is not None:
        return SINGLE, [files.read(shot.where, shot.stored)]
    bracket = Bracket.of([shot.files[0]])
    exposures: list[NDArray[Any]] = []
    for (path,) in bracket.files:
        exposures.append(files.read(path))
        require(
            (exposures[-1].shape, exposures[-1].dtype) == (exposures[0].shape, exposures[0].dtype),
            path,
            expected=f"{kind_of(exposures[0])} like {bracket.files[0][0].name}",
            found=kind_of(exposures[-1]),
            remedy="Save all exposures with the same settings.",
        )
    return bracket, exposures


def _cut(part: Part | None, shape: tuple[int, ...], step: int) -> tuple[slice, slice] | None:
    """Return the samples of a mosaic that are needed to develop a part of its picture.

    They are complete superpixels, with a margin of ``AROUND``.

    Args:
        part: part of the picture.
        shape: shape of the mosaic, rows and columns.
        step: samples per pixel in each direction.

    Returns:
        Slices of the rows and of the columns. None if the part is more than half of the mosaic, which is then developed
        as a whole.
    """
    if part is None:
        return None
    ends = []
    for begin, length, size in ((part[1], part[3], shape[0]), (part[0], part[2], shape[1])):
        low = max(0, begin * step - AROUND) // 8 * 8
        ends.append(slice(low, max(low, min(size, -(-((begin + length) * step + AROUND) // 8) * 8))))
    rows, columns = ends
    area = (rows.stop - rows.start) * (columns.stop - columns.start)
    return (rows, columns) if 0 < 2 * area <= shape[0] * shape[1] else None


_MAPS = 4 * (4 * 3 + 3 + 5)
"""Bytes per pixel that the intensities and the first maps need. They decide if a shot fits into memory."""


def develop(shot: ExposureSet, options: ShotOptions, part: Part | None = None) -> Developed:
    """Read and develop a shot at four angles.

    Args:
        shot: the shot.
        options: options of reading.
        part: requested part of the picture of a mosaic. If None, the whole picture is developed.

    Raises:
        PolarguideError: a file is missing or cannot be read, or the files do not fit each other or the options.
    """
    if shot.kind == "mosaic":
        try:
            return develop_mosaic(shot, options, part)
        except PolarguideError as error:
            if error.where.startswith(str(shot.where)):
                raise
            # An option or the dark frame does not fit this file, which the error has to name.
            raise PolarguideError(
                f"{shot.where} ({error.where})",
                expected=error.expected,
                found=error.found,
                remedy=error.remedy,
            ) from error
    if shot.kind == "filter":
        return _filter(shot, options)
    data, scale = _read_view(shot, options)
    return _undistorted(
        oriented(data.codes.astype(np.float32) / np.float32(FULL_CODE), options.calibration),
        data.black,
        data.saturated(scale) & ~data.black,
        data.invalid,
        data.mask,
        1 / data.largest_value,
        options,
    )


def set_samples(shot: ExposureSet, options: ShotOptions) -> SetSamples | None:
    """Read the samples of a shot at any polarizer angles.

    Return None for four usual angles or a mosaic, which ``develop`` reads.

    Raises:
        PolarguideError: a file is missing or cannot be read, or the files do not fit each other or the options.
    """
    if shot.kind == "set" and shot.stored is not None:
        return samples_of_arrays(shot.name, shot.stored, shot.angles, options)
    if shot.kind == "set":
        return read_set(shot.name, shot.pictures, options)
    if shot.kind != "scene" or shot.files:
        return None
    data, scale = _read_view(shot, options)
    return samples_of_view(data, scale, options)


def check_files(options: ShotOptions) -> None:
    """Validate the dark frame and the calibration once, before the first of many shots is read.

    Raises:
        PolarguideError: a file is missing, or the calibration is damaged or belongs to a different sensor.
    """
    if options.dark_frame is not None:
        require_file(options.dark_frame, expected="a dark frame", remedy="Check --dark-frame.")
    calibration_of(options)


def _four(shot: ExposureSet, levels: Levels | None = None) -> BracketedShots:
    """Return the four pictures of a shot at all exposures, from its files or from memory.

    Raises:
        PolarguideError: a file cannot be read, or the pictures differ in size, depth or orientation.
    """
    if shot.stored is not None:
        return BracketedShots.single(stacked(shot.stored, levels=levels))
    files = list(shot.files.values())
    require_memory_of_each(
        files,
        _READ * len(all_exposures(files)) // len(files),
        "four shots",
        remedy="Make the pictures smaller, all by the same factor.",
    )
    return BracketedShots.read([shot.files[angle] for angle in ANGLES], levels=levels)


def _filter(shot: ExposureSet, options: ShotOptions) -> Developed:
    """Develop four shots through a filter.

    Raises:
        PolarguideError: a file is missing or cannot be read, or the files do not fit each other or the options.
    """
    if shot.stored is None:
        require_four_shots(shot.paths[0].parent, {shot.name: shot.files})
    paths = [shot.files[angle] for angle in ANGLES] if shot.stored is None else []
    read = _four(shot)
    stored = [picture for shots in read.shots for picture in shots.pictures]
    container = 8 * stored[0].dtype.itemsize
    levels, notes = levels_of_shot(np.stack(stored), container, options, bits=options.bits or container)
    if not levels.is_full(container):
        read = _four(shot, levels)
    shots = read.shots[read.bracket.normal]
    decision = transfer_of_pictures(paths, options.transfer, lambda: [(shots, ANGLES)])
    notes += [decision.note, *filter(None, [decision.doubt])]
    linear = LinearShots.of(read, decision.transfer, align=options.align)
    notes += [] if read.bracket.single else bracket_notes([linear.exposures])
    moved = moved_shots(linear.shifts)
    notes += [f"Shots moved, in pixels: {', '.join(moved)}."] if moved else []
    stated: Sequence[float] = UNIT_GAINS
    if options.gains != "none" and paths:
        stated, corrected = stated_of_shot(paths)
        notes += corrected
    labels = [path.name for path in paths] or [f"picture {number}" for number in (1, 2, 3, 4)]
    intensities, _, warning = linear.evenly_exposed(labels, stated, options)
    notes += [f"Shots {warning}"] if warning else []
    usable = ~linear.invalid
    ratio = pair_ratio(intensities.mean(axis=3), usable)
    gains, gain_notes = pair_gains(ratio, options, _GAINS)
    intensities = intensities / np.asarray(gains, np.float32)[:, None, None, None]
    lsb = 1 / float(levels.white)
    noise = given_noise(options, lsb)
    # The luminance is the mean of three samples with independent noise, or of three copies in gray files.
    samples = 1 if (shots.pictures[..., :1] == shots.pictures).all() else 3
    factor = 1.0 if noise is None else 1 / samples
    noise = noise or estimated_noise(intensities.mean(axis=3), usable, lsb / samples**0.5)
    dark, saturated, outside = (
        np.ascontiguousarray(apply_orientation(mask, shots.orientation))
        for mask in (linear.dark, linear.saturated, linear.outside)
    )
    return Developed(
        intensities=np.ascontiguousarray(as_displayed(intensities, options.calibration, shots.orientation)),
        dark=dark,
        saturated=saturated,
        masked=outside,
        noise=noise,
        factors=np.full((4, 1, 1), factor, np.float32),
        mean_variance=factor,
        pair_ratio=ratio,
        notes=(*notes, *gain_notes),
    )


def _read_view(shot: ExposureSet, options: ShotOptions) -> tuple[ViewData, int | None]:
    """Read a view of a scene.

    Returns:
        The view; and the stored value at which it saturates, or None if the scene does not state this value.
    """
    assert shot.root is not None
    layout = find_layout(shot.root)
    select_views(layout, [shot.view])
    require_memory_of_each(
        shot.paths,
        max(1, len(shot.paths) // 4) * (KEPT + READ) + _MAPS,
        "a view",
        remedy="Free memory, or prepare the scene in a smaller size.",
    )
    data = read_view(layout, shot.view, factor=1, transfer="srgb" if options.transfer == "srgb" else "linear")
    return data, checks.full_scale(data.histogram, data.largest_value)


def _undistorted(
    intensities: Map,
    dark: Mask,
    saturated: Mask,
    invalid: Mask,
    foreground: Mask | None,
    lsb: float,
    options: ShotOptions,
) -> Developed:
    """Return the developed intensities of a view of a scene, whose pixels are already complete samples.

    Args:
        intensities: [4, H, W, C].
        dark: mask [H, W] of dark pixels.
        saturated: mask [H, W] of saturated pixels.
        invalid: mask [H, W] of invalid pixels.
        foreground: mask [H, W] of the object in the view, or None.
        lsb: step between two stored values, as a share of full scale.
        options: options of reading.
    """
    gray = intensities.mean(axis=3)
    good = ~(saturated | dark | invalid)
    return Developed(
        intensities=intensities,
        dark=dark,
        saturated=saturated,
        masked=invalid if foreground is None else invalid | ~foreground,
        noise=given_noise(options, lsb) or estimated_noise(gray, good, lsb),
        factors=np.ones((4, 1, 1), np.float32),
        mean_variance=1.0,
        pair_ratio=pair_ratio(gray, good),
        notes=(),
    )
