"""Shots without files, and folders of small mosaics."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from camera_files import write_mosaics

from polarguide_shots.maps import NoiseModel, Reason, ShotMaps
from polarguide_shots.options import ShotOptions

MONO = ShotOptions(sensor="IMX250MZR", bits=12)


@pytest.fixture
def reading() -> ShotOptions:
    return MONO


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Mosaics v000, v001, v002 of 64x48 pixels, each darker than the one before."""
    root = tmp_path / "shots"
    root.mkdir()
    write_mosaics(root, 3, color=False, bits=12)
    return root


@pytest.fixture
def made_maps():
    """Return a function that creates the maps of a shot from random numbers, with all reasons."""

    def make(seed: int = 0, height: int = 40, width: int = 50) -> ShotMaps:
        rng = np.random.default_rng(seed)
        shape = (height, width)
        dolp = rng.beta(2, 8, shape).astype(np.float32)
        aolp = np.remainder(rng.normal(3.1, 0.4, shape), np.pi).astype(np.float32)
        s0 = rng.uniform(0.1, 1.9, shape).astype(np.float32)
        stokes = np.stack([s0, s0 * dolp * np.cos(2 * aolp), s0 * dolp * np.sin(2 * aolp)])
        reason = rng.choice(len(Reason), size=shape, p=[0.6, 0.1, 0.1, 0.1, 0.1]).astype(np.uint8)
        return ShotMaps(
            name="made",
            files=(Path("made.png"),),
            intensities=np.zeros((4, *shape, 1), np.float32),
            stokes=stokes.astype(np.float32),
            dolp=dolp,
            dolp_debiased=dolp,
            aolp=aolp,
            sigma_dolp=np.zeros(shape, np.float32),
            sigma_aolp=np.zeros(shape, np.float32),
            reason=reason,
            noise=NoiseModel(1e-6, 1e-4, "given"),
            pair_ratio=1.0,
        )

    return make
