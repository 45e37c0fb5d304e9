"""Exported splats read by a program that is not ours: PlayCanvas' ``splat-transform`` turns them into a PLY again.

``make test`` installs it where npm is; another one is found on the PATH, or named by ``SPLAT_TRANSFORM``.
"""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from polarguide.cli.app import run
from polarguide.gaussians.ply import read_ply

PLACES = (
    str(Path(__file__).resolve().parents[2] / "build/node/node_modules/.bin"),
    os.environ.get("PATH", ""),
)
PROGRAM = shutil.which(os.environ.get("SPLAT_TRANSFORM", "splat-transform"), path=os.pathsep.join(PLACES))
pytestmark = [
    pytest.mark.skipif(PROGRAM is None, reason="no splat-transform -> apt-get install nodejs npm; make test"),
    pytest.mark.slow,
]
# Largest error of the median Gaussian. Harmonics have 4 bits in SPZ (steps of 1/8), and come from a palette in SOG.
EXACT = 1e-5
TOLERANCES = {
    "ply": dict.fromkeys(("means", "opacity", "log_scales", "turn", "sh_dc", "sh_rest"), EXACT),
    "spz": {"means": 3e-4, "opacity": 3e-3, "log_scales": 0.04, "turn": 0.02, "sh_dc": 0.02, "sh_rest": 0.07},
    "sog": {"means": 3e-3, "opacity": 3e-3, "log_scales": 0.02, "turn": 0.01, "sh_dc": 0.01, "sh_rest": 0.02},
}


def described(path: Path) -> dict[str, np.ndarray]:
    """What both programs agree to call a Gaussian: [N, ...] by name, quaternions of unit length with w positive."""
    rows = {name: values.double().numpy() for name, values in read_ply(path).items() if name != "extra"}
    turn = rows["quaternions"] / np.linalg.norm(rows["quaternions"], axis=1, keepdims=True)
    return {
        "means": rows["means"],
        "opacity": (1 / (1 + np.exp(-rows["opacity_logits"])))[:, None],
        "log_scales": rows["log_scales"],
        "turn": turn * np.where(turn[:, :1] < 0, -1, 1),
        "sh_dc": rows["sh_dc"].reshape(len(turn), -1),
        "sh_rest": rows["sh_rest"].reshape(len(turn), -1),
    }


@pytest.mark.parametrize("kind", TOLERANCES)
def test_another_program_reads_our_splats(kind: str, trained: Path, tmp_path: Path) -> None:
    if kind == "spz":
        pytest.importorskip("gaussforge")
    assert run(["export", str(trained), "--format", kind, "--out", str(tmp_path), "--threads", "1"]) == 0
    back = tmp_path / "back.ply"
    assert PROGRAM is not None
    subprocess.run([PROGRAM, "-q", str(tmp_path / f"splats.{kind}"), str(back)], check=True, timeout=300)
    ours, theirs = described(trained / "point_cloud.ply"), described(back)
    assert len(ours["means"]) == len(theirs["means"])
    distance, nearest = cKDTree(theirs["means"]).query(ours["means"])
    extent = np.ptp(ours["means"], axis=0).max()
    assert np.quantile(distance, 0.99) < 1e-3 * extent
    for name, tolerance in TOLERANCES[kind].items():
        error = np.abs(theirs[name][nearest] - ours[name]).max(axis=1)
        if name == "turn":  # q and -q are one rotation, and w may be near 0
            error = np.minimum(error, np.abs(theirs[name][nearest] + ours[name]).max(axis=1))
        assert np.median(error) < tolerance, name
