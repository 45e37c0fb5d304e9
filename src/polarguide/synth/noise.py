"""Fractal value noise."""

from __future__ import annotations

import itertools

import numpy as np

from polarguide.synth.mesh import Array


def fractal_noise(points: Array, seed: int, octaves: int = 4) -> Array:
    """Value noise in [0, 1] at points [..., D]: octaves of halving scale and amplitude, the first with unit cells."""
    total = np.zeros(points.shape[:-1])
    weight, sums = 1.0, 0.0
    for octave in range(octaves):
        total += weight * _value(points * 2.0**octave + 17.3 * octave, seed * 31 + octave)
        sums += weight
        weight /= 2
    return total / sums


def _value(points: Array, seed: int) -> Array:
    """Random numbers at lattice points, interpolated by a quintic (its second derivative is continuous)."""
    cell = np.floor(points).astype(np.int64)
    t = points - cell
    t = t * t * t * (t * (6 * t - 15) + 10)
    total = np.zeros(points.shape[:-1])
    for corner in itertools.product((0, 1), repeat=points.shape[-1]):
        weight = np.prod([t[..., k] if c else 1 - t[..., k] for k, c in enumerate(corner)], axis=0)
        total += weight * _hash(cell + np.array(corner), seed)
    return total


def _hash(cell: np.ndarray, seed: int) -> Array:
    """A pseudorandom number in [0, 1) for each lattice point: a multiplicative hash with xor shifts."""
    value = np.full(cell.shape[:-1], (seed * 0x9E3779B9 + 0x7F4A7C15) & 0xFFFFFFFF, np.uint64)
    for k in range(cell.shape[-1]):
        value = (value ^ (cell[..., k].astype(np.uint64) & np.uint64(0xFFFFFFFF))) * np.uint64(
            0x9E3779B97F4A7C15
        )
        value ^= value >> np.uint64(29)
    value *= np.uint64(0xBF58476D1CE4E5B9)
    value ^= value >> np.uint64(32)
    return (value & np.uint64(0xFFFFFF)).astype(np.float64) / 0x1000000
