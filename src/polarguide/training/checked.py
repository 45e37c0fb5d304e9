"""Checks of a checkpoint: every tensor is checked here before anything computes with it.

The kernels and the fused optimizer take shapes at their word, so a tensor that does not fit would be read or written
beyond its end; one that is not finite would show as a picture of nothing.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from polarguide.gaussians.adam import MOMENTS
from polarguide.training.recipe import Recipe
from polarguide.training.state import ANGLE_COLUMNS

LARGEST = {"means": 1e12, "log_scales": 1e4}
LARGEST_VALUE = 1e8
LARGEST_LOG_SCALE = 60.0
MOST_SLOTS = 4096


def refuse_foreign(tensors: Mapping[str, Tensor], recipe: Recipe) -> None:
    """Check that tensors are what a training of the recipe leaves.

    Shapes are those that the recipe and its shading model state. Parameters and Adam's moments are finite float32 of
    plausible size, rotations have a length, second moments and sums are not negative. The copy from which priors are
    computed may have another number of Gaussians. No other tensors are allowed.

    Raises:
        ValueError: one is missing, is not known, or has another shape, type or range; the message names it.
    """
    names = {"scalars", "statistics.gradient", "statistics.seen"}
    count = _count(tensors, "gaussians.means")
    shapes = {name: (count, *shape) for name, shape in recipe.shapes.items()}
    light = {name: parameter.shape for name, parameter in recipe.shading.light_parameters.items()}
    for kind, table, rates in (
        ("gaussians", shapes, recipe.learning_rates),
        ("environment", light, recipe.light_rates),
    ):
        for name, shape in table.items():
            _check_values(tensors, f"{kind}.{name}", shape, name)
            names.add(f"{kind}.{name}")
            if name in rates:
                names |= _check_moments(tensors, _moments(kind, name), shape)
    if any(name.startswith("frozen.") for name in tensors):
        frozen = _count(tensors, "frozen.means")
        for name, each in recipe.shapes.items():
            _check_values(tensors, f"frozen.{name}", (frozen, *each), name)
            names.add(f"frozen.{name}")
    _check_statistics(tensors, count)
    _check_scalars(tensors)
    if "angles" in tensors:
        _check_angles(tensors["angles"])
        names.add("angles")
    if "footprints" in tensors:
        values = _shaped(tensors, "footprints", (count,))
        if float(values.min()) < 0 or float(values.max()) > LARGEST["means"]:
            raise ValueError(f"footprints from {float(values.min()):g} to {float(values.max()):g}")
        names.add("footprints")
    strangers = sorted(name for name in tensors.keys() - names if not name.startswith("callback."))
    if strangers:
        raise ValueError(f"{strangers[0][:80]}, which is not known")


def _moments(kind: str, name: str) -> str:
    """The prefix of the names of a tensor's moments, as ``Trained`` and ``Environment`` write them."""
    if kind == "gaussians":
        return f"adam.{name}."
    return "environment.adam." if name == "texels" else f"environment.adam.{name}."


def _count(tensors: Mapping[str, Tensor], name: str) -> int:
    means = _given(tensors, name)
    if means.ndim != 2:
        raise ValueError(f"{name} of shape {list(means.shape)}, not [N, 3]")
    if not len(means):  # densification always leaves one
        raise ValueError(f"{name} of no Gaussian")
    return int(means.shape[0])


def _given(tensors: Mapping[str, Tensor], name: str) -> Tensor:
    if name not in tensors:
        raise ValueError(f"no {name}")
    return tensors[name]


def _shaped(tensors: Mapping[str, Tensor], name: str, shape: tuple[int, ...]) -> Tensor:
    """A tensor of finite float32 in a shape."""
    values = _given(tensors, name)
    if values.dtype != torch.float32 or tuple(values.shape) != tuple(shape):
        found = f"{list(values.shape)}, {values.dtype}"
        raise ValueError(f"{name} of shape {found}, not {list(shape)}, torch.float32")
    if not bool(torch.isfinite(values).all()):
        raise ValueError(f"{name} with values that are not finite")
    return values


def _check_values(tensors: Mapping[str, Tensor], full: str, shape: tuple[int, ...], name: str) -> None:
    values = _shaped(tensors, full, shape)
    most = LARGEST.get(name, LARGEST_VALUE)
    if float(values.abs().max()) > most or (name == "log_scales" and float(values.max()) > LARGEST_LOG_SCALE):
        raise ValueError(f"{full} with values as large as {float(values.abs().max()):g}")
    if name == "quaternions" and float(values.abs().amax(dim=-1).min()) == 0:
        raise ValueError(f"{full} with rotations of length zero")


def _check_moments(tensors: Mapping[str, Tensor], prefix: str, shape: tuple[int, ...]) -> set[str]:
    """Check Adam's moments of one tensor, all of them or none; returns their names."""
    names = {prefix + key for key in MOMENTS}
    there = names & tensors.keys()
    if not there:
        return names
    if there != names:
        raise ValueError(f"no {min(names - there)}")
    _shaped(tensors, prefix + "exp_avg", shape)
    for key, of in (("exp_avg_sq", shape), ("step", ())):
        values = _shaped(tensors, prefix + key, of)
        if values.numel() and float(values.min()) < 0:
            raise ValueError(f"{prefix}{key} with negative values")
    return names


def _check_statistics(tensors: Mapping[str, Tensor], count: int) -> None:
    shape = tuple(_given(tensors, "statistics.gradient").shape)
    if shape[-1:] != (count,) or len(shape) > 2 or (len(shape) == 2 and not 1 < shape[0] <= MOST_SLOTS):
        raise ValueError(f"statistics.gradient of shape {list(shape)}, not [{count}] or [S, {count}]")
    for name in ("statistics.gradient", "statistics.seen"):
        values = _shaped(tensors, name, shape)
        if values.numel() and float(values.min()) < 0:
            raise ValueError(f"{name} with negative values")


def _check_angles(values: Tensor) -> None:
    """Check what was found of polarizers: rows of a float64 table, as ``Polarizers`` leaves it."""
    if (
        values.dtype != torch.float64
        or values.ndim != 3
        or values.shape[2] != ANGLE_COLUMNS
        or not len(values)
    ):
        raise ValueError(
            f"angles of shape {list(values.shape)}, {values.dtype}, not [F, P, {ANGLE_COLUMNS}], torch.float64"
        )
    if not bool(torch.isfinite(values).all()) or (values.numel() and float(values.min()) < 0):
        raise ValueError("angles with values that are negative or not finite")
    if values.numel() and float(values[..., 1].min()) <= 0:
        raise ValueError("angles with gains that are not positive")


def _check_scalars(tensors: Mapping[str, Tensor]) -> None:
    scalars = _given(tensors, "scalars")
    if scalars.dtype != torch.int64 or tuple(scalars.shape) != (2,):
        raise ValueError(f"scalars of shape {list(scalars.shape)}, {scalars.dtype}, not [2], torch.int64")
    step, frozen_until = scalars.tolist()
    if min(step, frozen_until) < 0 or max(step, frozen_until) > 1 << 50:
        raise ValueError(f"scalars {scalars.tolist()}")
