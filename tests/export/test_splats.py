"""The PLY of a run with each shading model: display colors, and the model's own fields."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from random_runs import random_state
from torch.nn.functional import normalize

from polarguide.color import srgb_encode
from polarguide.gaussians.geometry import shortest_axis_normals
from polarguide.gaussians.ply import read_ply
from polarguide.runs.point_cloud import shown_colors, write_run_ply

COUNT = 7
FIELDS = {
    "3dgs": {"linear_dc", "linear_rest"},
    "3dgs-dr": {"linear_dc", "linear_rest", "strength"},
    "ref-gs": {"albedo", "roughness", "feature"},
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
