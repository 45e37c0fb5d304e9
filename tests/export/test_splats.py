"""The PLY of a run with each shading model: display colors, and the model's own fields."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from random_runs import random_state
from scipy.spatial.transform import Rotation
from torch.nn.functional import normalize

from polarguide.color import srgb_encode
from polarguide.gaussians.geometry import shortest_axis_normals
from polarguide.gaussians.ply import read_ply
from polarguide.runs.model import shown_colors, write_run_ply

COUNT = 7
FIELDS = {
    "3dgs": {"linear_dc", "linear_rest"},
    "3dgs-dr": {"linear_dc", "linear_rest", "strength"},
    "ref-gs": {"linear_dc", "linear_rest", "albedo", "roughness", "feature", "surface"},
}


@pytest.mark.parametrize("name", FIELDS)
def test_the_file_holds_display_colors_and_the_fields_of_the_model(name: str, tmp_path: Path) -> None:
    state, shading = random_state(name, COUNT)
    write_run_ply(tmp_path / "run.ply", state, shading)
    read = read_ply(tmp_path / "run.ply")
    assert set(read["extra"]) == FIELDS[name]
    assert all(bool(torch.isfinite(t).all()) for t in (read["sh_dc"], read["sh_rest"]))
    for field, values in shading.fields(state.gaussians).items():
        torch.testing.assert_close(read["extra"][field], values.detach())


@pytest.mark.parametrize("name", FIELDS)
def test_colors_are_in_range_and_change_with_the_view(name: str) -> None:
    state, shading = random_state(name, COUNT)
    directions = normalize(torch.randn(5, 3, generator=torch.Generator().manual_seed(1)), dim=-1)
    colors = shown_colors(state, shading, directions)
    assert colors.shape == (COUNT, 5, 3)
    assert 0 <= float(colors.min()) <= float(colors.max()) <= 1
    assert float(colors.std(dim=1).max()) > 1e-4


def test_a_directional_gaussian_shows_its_albedo_and_the_light_in_its_mirror() -> None:
    state, shading = random_state("ref-gs", COUNT)
    gaussians, ray = state.gaussians, torch.tensor([[0.0, 0.6, 0.8]])
    shape = (gaussians[name] for name in ("means", "quaternions", "log_scales"))
    normals = shortest_axis_normals(*shape, torch.zeros(3))
    facing = torch.where(normals @ ray[0][:, None] > 0, -normals, normals)
    linear = shading.colors(gaussians, state.light, ray.expand(COUNT, 3), facing)
    expected = srgb_encode(linear.detach().clamp(0, 1))
    torch.testing.assert_close(shown_colors(state, shading, ray)[:, 0], expected)


def test_normals_are_the_learned_ones_and_face_the_nearest_camera(tmp_path: Path) -> None:
    """Read by trimesh, which takes nx, ny, nz for the normals of its vertices."""
    trimesh = pytest.importorskip("trimesh")
    state, shading = random_state("3dgs", 50)
    centers = torch.tensor([[9.0, 0.0, 0.0], [-9.0, 0.0, 0.0]])
    write_run_ply(tmp_path / "run.ply", state, shading, centers)
    raw = trimesh.load(tmp_path / "run.ply").metadata["_ply_raw"]["vertex"]["data"]
    normals = torch.from_numpy(
        np.stack([raw[name] for name in ("nx", "ny", "nz")], axis=1).astype(np.float64)
    )
    torch.testing.assert_close(normals.norm(dim=1), torch.ones(50, dtype=torch.float64), atol=1e-5, rtol=0)
    means = state.gaussians["means"].detach().double()
    rotations = Rotation.from_quat(state.gaussians["quaternions"].detach().double()[:, [1, 2, 3, 0]].numpy())
    axes = torch.from_numpy(rotations.as_matrix())
    shortest = axes[torch.arange(50), :, state.gaussians["log_scales"].detach().argmin(dim=1)]
    assert bool(((normals * shortest).sum(dim=1).abs() > 0.9999).all())
    nearest = centers.double()[(means[:, :1] < 0).long()[:, 0]]
    assert bool(((normals * (nearest - means)).sum(dim=1) >= -1e-6).all())
