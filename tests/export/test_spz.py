"""Half a turn about x, from our axes (right, down, forward) to those of SPZ (right, up, back)."""

from __future__ import annotations

import gzip
from pathlib import Path

import pytest
import torch
from random_runs import random_state
from torch.nn.functional import normalize

from polarguide.export.spz import _half_turned, write_spz
from polarguide.gaussians.geometry import quaternions_to_rotations
from polarguide.gaussians.harmonics import sh_basis
from polarguide.gaussians.ply import read_ply
from polarguide.runs.model import write_run_ply

TURN = torch.diag(torch.tensor([1.0, -1.0, -1.0]))


def test_the_whole_scene_is_turned(tmp_path: Path) -> None:
    generator = torch.Generator().manual_seed(1)
    state, shading = random_state("3dgs", 7)
    write_run_ply(tmp_path / "run.ply", state, shading)
    ours = read_ply(tmp_path / "run.ply")
    turned = read_ply(_half_turned(tmp_path / "run.ply"))
    torch.testing.assert_close(turned["means"], ours["means"] @ TURN.T)
    # Both sets of axes span the same ellipsoid.
    ellipsoids = [
        quaternions_to_rotations(rows["quaternions"]) * rows["log_scales"].exp()[:, None]
        for rows in (ours, turned)
    ]
    expected, found = (axes @ axes.mT for axes in (TURN @ ellipsoids[0], ellipsoids[1]))
    torch.testing.assert_close(found, expected)
    # What is seen along a turned direction is what was seen along the direction.
    directions = normalize(torch.randn(20, 3, generator=generator), dim=-1)
    for rest in (ours["sh_rest"], turned["sh_rest"]):
        assert rest.shape[1] == 15
        assert bool((rest.abs().amax(dim=(0, 2)) > 1e-3).all()), "every harmonic takes part"
    before = torch.einsum("dk,nkc->ndc", sh_basis(directions, 3)[:, 1:], ours["sh_rest"])
    after = torch.einsum("dk,nkc->ndc", sh_basis(directions @ TURN.T, 3)[:, 1:], turned["sh_rest"])
    torch.testing.assert_close(after, before, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("version", [3, 4])
def test_both_versions_are_written_and_read(tmp_path: Path, version: int) -> None:
    forge = pytest.importorskip("gaussforge").GaussForge()
    state, shading = random_state("3dgs", 7)
    write_run_ply(tmp_path / "run.ply", state, shading)
    write_spz(tmp_path / "run.spz", tmp_path / "run.ply", version)
    data = (tmp_path / "run.spz").read_bytes()
    head = gzip.decompress(data) if version == 3 else data
    assert head[:4] == b"NGSP"
    assert int.from_bytes(head[4:8], "little") == version
    (tmp_path / "back.ply").write_bytes(forge.convert(data, "spz", "ply")["data"])
    found, ours = read_ply(tmp_path / "back.ply"), read_ply(tmp_path / "run.ply")
    torch.testing.assert_close(found["means"], ours["means"] @ TURN.T, atol=1 / 4096, rtol=0)
