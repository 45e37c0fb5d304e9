"""SOG files, read back by the rules of the format's specification."""

from __future__ import annotations

import io
import json
import math
import zipfile
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from polarguide.export.sog import write_sog
from polarguide.gaussians.ply import read_ply, write_ply

COUNT = 3000


@pytest.fixture(scope="module")
def ply(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Random Gaussians, some of them far away, one of them invisible."""
    generator = torch.Generator().manual_seed(0)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator)

    path = tmp_path_factory.mktemp("sog") / "in.ply"
    opacity = 3 * normal(COUNT)
    opacity[0] = -30
    write_ply(
        path,
        means=normal(COUNT, 3) * torch.exp(2 * normal(COUNT, 1)),
        log_scales=normal(COUNT, 3) - 3,
        quaternions=normal(COUNT, 4),
        opacity_logits=opacity,
        sh_dc=normal(COUNT, 1, 3),
        sh_rest=0.1 * normal(COUNT, 15, 3),
    )
    return path


def decoded(path: Path) -> dict[str, np.ndarray]:
    """Rows [N, ...] by name, in the file's order."""
    with zipfile.ZipFile(io.BytesIO(path.read_bytes())) as file:
        meta = json.loads(file.read("meta.json"))
        pictures = {
            name: cv2.imdecode(np.frombuffer(file.read(name), np.uint8), cv2.IMREAD_UNCHANGED)
            for name in file.namelist()
            if name.endswith(".webp")
        }
    assert meta["version"] == 2
    count = meta["count"]

    def pixels(name: str) -> np.ndarray:
        picture = pictures[name]
        order = [2, 1, 0, 3][: picture.shape[2]]
        return picture[..., order].reshape(-1, picture.shape[2]).astype(int)

    low, high = (np.array(meta["means"][key]) for key in ("mins", "maxs"))
    codes = pixels("means_l.webp")[:count, :3] + 256 * pixels("means_u.webp")[:count, :3]
    logs = low + codes / 65535 * (high - low)
    quats = pixels("quats.webp")[:count]
    three, largest = (quats[:, :3] / 255 - 0.5) * math.sqrt(2), quats[:, 3] - 252
    turns = np.zeros((count, 4))
    for row, (values, place) in enumerate(zip(three, largest, strict=True)):
        turns[row, [k for k in range(4) if k != place]] = values
        turns[row, place] = math.sqrt(max(0.0, 1 - (values**2).sum()))
    label = pixels("shN_labels.webp")[:count]
    label = label[:, 0] + 256 * label[:, 1]
    palette = np.array(meta["shN"]["codebook"])[pixels("shN_centroids.webp")[:, :3]].reshape(-1, 15, 3)
    sh0 = pixels("sh0.webp")[:count]
    return {
        "means": np.sign(logs) * np.expm1(np.abs(logs)),
        "log_scales": np.array(meta["scales"]["codebook"])[pixels("scales.webp")[:count, :3]],
        "turns": turns,
        "opacity": sh0[:, 3] / 255,
        "sh_dc": np.array(meta["sh0"]["codebook"])[sh0[:, :3]],
        "sh_rest": palette[label],
    }


def test_what_is_read_back_is_what_was_written(ply: Path, tmp_path: Path) -> None:
    write_sog(tmp_path / "a.sog", ply)
    ours, found = read_ply(ply), decoded(tmp_path / "a.sog")
    # The order is another one: sort both by opacity and place.
    means = ours["means"].double().numpy()
    distance = np.linalg.norm(means[:, None] - found["means"][None], axis=2)
    at = distance.argmin(axis=1)
    assert len(set(at)) == COUNT
    step = 2 * (1 + np.abs(means)) * np.log1p(np.abs(means)).max() * 2 / 65535
    assert (np.abs(found["means"][at] - means) <= step).all()
    opacity = torch.sigmoid(ours["opacity_logits"].flatten()).numpy()
    assert np.abs(found["opacity"][at] - opacity).max() <= 0.5 / 255 + 1e-6
    unit = torch.nn.functional.normalize(ours["quaternions"], dim=1).numpy()
    assert (1 - np.abs((found["turns"][at] * unit).sum(axis=1))).max() < 1e-4
    seen = opacity > 0.002  # what cannot be seen may lose its color
    for name, error in (("log_scales", 0.1), ("sh_dc", 0.1)):
        expected = ours[name].reshape(COUNT, -1).numpy()
        assert np.quantile(np.abs(found[name][at] - expected)[seen], 0.99) < error, name
    # Random harmonics are the worst case of a palette: 3,000 in 2,048 places. Many keep a place to themselves.
    rest = ours["sh_rest"].reshape(COUNT, -1).numpy()
    errors = found["sh_rest"].reshape(COUNT, -1)[at] - rest
    assert np.sqrt(np.mean(errors**2)) < 0.8 * np.sqrt(np.mean(rest**2))
    assert np.quantile(np.abs(errors).max(axis=1), 0.25) < 0.02


def test_the_same_splats_make_the_same_file(ply: Path, tmp_path: Path) -> None:
    for name in ("a.sog", "b.sog"):
        write_sog(tmp_path / name, ply)
    assert (tmp_path / "a.sog").read_bytes() == (tmp_path / "b.sog").read_bytes()


def test_few_splats_are_splats_too(tmp_path: Path) -> None:
    rows = {"means": (3,), "log_scales": (3,), "quaternions": (4,), "opacity_logits": ()}
    zeros = {name: torch.ones(2, *shape) for name, shape in rows.items()}
    write_ply(tmp_path / "in.ply", **zeros, sh_dc=torch.zeros(2, 1, 3), sh_rest=torch.zeros(2, 15, 3))
    write_sog(tmp_path / "out.sog", tmp_path / "in.ply")
    found = decoded(tmp_path / "out.sog")
    assert np.allclose(found["means"], 1)
    assert np.allclose(found["log_scales"], 1)
    assert (found["sh_rest"] == 0).all()
