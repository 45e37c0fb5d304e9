"""Published datasets as their loaders and copies of other projects have them: numbers, folders, masks, sense."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from camera_files import write_model
from dataset_files import (
    HEIGHT,
    WIDTH,
    WRITERS,
    disc,
    idr_cameras,
    light_of,
    poses,
    write_nersp,
    write_pandora,
)
from faults import Fault

from polarguide.capture.calibration import Calibration
from polarguide.capture.formats.pictures import read_mask
from polarguide.core.errors import PolarguideWarning
from polarguide.preparation.datasets import LAYOUTS, detect_dataset
from polarguide.preparation.prepare import prepare_scene
from polarguide.preparation.settings import PrepareSettings
from polarguide_bench.datasets.dataset import Dataset
from polarguide_bench.datasets.outlines import OutlineAgreement, outline_agreement, sense_of_outlines
from polarguide_bench.datasets.readers import READERS, open_dataset
from polarguide_bench.datasets.sources import StokesSource

Change = Callable[[Path], object]


def renumbered(style: str, first: int) -> Change:
    """Cameras counted from another number, padded or not."""

    def change(root: Path) -> None:
        with np.load(root / "cameras.npz") as file:
            arrays = {name: file[name] for name in file}
        kinds = ("world_mat_", "scale_mat_")
        np.savez(
            root / "cameras.npz",
            **{kind + style % (i + first): arrays[f"{kind}{i}"] for kind in kinds for i in range(4)},
        )

    return change


def renamed(**names: str) -> Change:
    return lambda root: [(root / old).rename(root / new) for old, new in names.items()]


def removed(*patterns: str) -> Change:
    return lambda root: [path.unlink() for pattern in patterns for path in root.glob(pattern)]


def archived(root: Path) -> None:
    """RMVP3D: an archive a view in place of three files."""
    (root / "images_stokes").mkdir()
    for path in sorted((root / "s0").iterdir()):
        planes = {f"S{k}": np.load(root / f"s{k}" / path.name).astype(np.float64) for k in range(3)}
        np.savez(root / "images_stokes" / f"{path.stem}.npz", **planes)
    for path in root.glob("s?/*"):
        path.unlink()
    for k in range(3):
        (root / f"s{k}").rmdir()


def mapped(root: Path) -> None:
    """NeRSP's copy of PANDORA: pictures and azimuth maps count from 0, masks are the alpha of the maps."""
    (root / "images").rename(root / "image")
    for index, path in enumerate(sorted((root / "image").iterdir())):
        path.rename(path.with_name(f"{index:04d}.png"))
    removed("mask/*")(root)
    (root / "mask").rmdir()
    (root / "input_azimuth_maps").mkdir()
    for index in range(4):
        pixels = np.zeros((HEIGHT, WIDTH, 4), np.uint16)
        pixels[..., 3] = np.roll(disc(), index, axis=1) * 65535
        assert cv2.imwrite(str(root / "input_azimuth_maps" / f"{index:04d}.png"), pixels)


def masks_from(first: int) -> Change:
    """Masks of three digits, which count from ``first``."""

    def change(root: Path) -> None:
        for index, path in enumerate(sorted((root / "mask").iterdir())):
            path.rename(path.with_name(f"{index + first:03d}.png"))

    return change


def cameras_of_light(root: Path) -> None:
    """Intrinsics of the size of the Stokes vectors, beside pictures of twice this size."""
    np.savez(root / "cameras.npz", **idr_cameras())


ALL = (0, 1, 2, 3)
POLGS = {"image": "train", "input_azimuth_maps": "train_input_azimuth_maps"}
CASES: dict[str, tuple[str, tuple[Change, ...], tuple[int, ...]]] = {
    "pandora, padded from 1": ("pandora", (renumbered("%02d", 1),), ALL),
    "pandora, from 1": ("pandora", (renumbered("%d", 1),), ALL),
    "pandora, from 0": ("pandora", (), ALL),
    # A view that was taken away leaves the others their cameras.
    "pandora, padded, without the first": ("pandora", (renumbered("%02d", 1), removed("*/01*")), (1, 2, 3)),
    "pandora, padded, without the last": ("pandora", (renumbered("%02d", 1), removed("*/04*")), (0, 1, 2)),
    "pandora, from 0, without the first": ("pandora", (removed("*/01*"),), (1, 2, 3)),
    "pandora, from 0, without the last": ("pandora", (removed("*/04*"),), (0, 1, 2)),
    "pandora, masks of other digits": ("pandora", (masks_from(1),), ALL),
    "pandora, resized pictures": ("pandora", (cameras_of_light,), ALL),
    "pandora in NeRSP": ("pandora", (mapped,), ALL),
    "pandora in PolGS": (
        "pandora",
        (renumbered("%02d", 1), mapped, renamed(images_stokes="train_images_stokes", **POLGS)),
        ALL,
    ),
    "nersp in PolGS": ("nersp", (renumbered("%02d", 1), renamed(**POLGS)), ALL),
    "nersp in PolGS, without the first": (
        "nersp", (renumbered("%02d", 1), renamed(**POLGS), removed("*/0000*")), (1, 2, 3),
    ),
    "nersp, without the first": ("nersp", (removed("*/0000*"),), (1, 2, 3)),
    "rmvp3d": ("nersp", (archived,), ALL),
    "rmvp3d, padded from 1": ("nersp", (archived, renumbered("%02d", 1)), ALL),
}  # fmt: skip


def changed(root: Path, name: str, changes: tuple[Change, ...]) -> Dataset:
    WRITERS[name](root)
    for change in changes:
        change(root)
    kind = detect_dataset(root)
    assert kind == name
    return open_dataset(root, kind)


def test_every_reader_has_a_layout() -> None:
    assert {*LAYOUTS, "pandora"} == READERS.keys()


@pytest.mark.parametrize("case", CASES)
def test_every_view_has_its_light_its_camera_and_its_mask(tmp_path: Path, case: str) -> None:
    name, changes, left = CASES[case]
    dataset = changed(tmp_path / "in", name, changes)
    assert len(dataset.views) == len(left)
    truth = list(poses())
    for index, view in zip(left, dataset.views, strict=True):
        rotation, translation = truth[index]
        assert dataset.cameras is not None
        camera = dataset.cameras[view]
        np.testing.assert_allclose(camera.rotation, rotation, atol=1e-6)
        np.testing.assert_allclose(camera.translation, translation, atol=1e-6)
        assert camera.parameters[2] / camera.width == pytest.approx(33 / WIDTH)
        assert dataset.read_stokes is not None
        stokes, _ = dataset.read_stokes(view)
        s0, s1, s2 = light_of(index)
        sign = -1 if name == "nersp" else 1
        np.testing.assert_allclose(stokes, [s0, s1, sign * s2], atol=0.02)
        shifted = index if "NeRSP" in case or case == "pandora in PolGS" else 0
        np.testing.assert_array_equal(
            dataset.read_mask(dataset.masks[view]), np.roll(disc(), shifted, axis=1)
        )


def test_sizes_that_no_principal_point_fits_are_warned_of(tmp_path: Path) -> None:
    def shrink(root: Path) -> None:
        for path in (root / "images").iterdir():
            assert cv2.imwrite(str(path), cv2.imread(str(path))[::2, ::2])

    with pytest.warns(PolarguideWarning, match="far from the middle of the pictures, 64x48"):
        changed(tmp_path / "in", "pandora", (shrink,))


def test_no_view_takes_the_mask_of_another_by_number(tmp_path: Path) -> None:
    with pytest.warns(PolarguideWarning, match=r"4 of 4 views \(01, 02, 03, 04\)"):
        assert not changed(tmp_path / "in", "pandora", (masks_from(0),)).masks


def test_a_missing_camera_is_named_and_no_view_is_to_be_removed(tmp_path: Path) -> None:
    write_pandora(tmp_path / "in")
    with np.load(tmp_path / "in" / "cameras.npz") as file:
        arrays = {name: file[name] for name in file if not name.endswith("_0")}
    np.savez(tmp_path / "in" / "cameras.npz", **arrays)
    error = Fault(expected="the entry world_mat_0 for view 01").raised_by(
        open_dataset, tmp_path / "in", "pandora"
    )
    assert "remove" not in error.remedy


def test_a_copy_with_a_colmap_model_brings_no_cameras_of_its_own(tmp_path: Path) -> None:
    """PhyGaP's copy of PANDORA."""
    write_pandora(tmp_path / "in")
    (tmp_path / "in" / "cameras.npz").unlink()
    model = write_model(
        tmp_path / "in" / "sparse" / "0", ("01", "02", "03"), f"PINHOLE {WIDTH} {HEIGHT} 90 92 33 23"
    )
    assert open_dataset(tmp_path / "in", "pandora").cameras is None
    settings = PrepareSettings(gains="none", poses=str(model))
    assert prepare_scene(tmp_path / "in", tmp_path / "out", settings).left_out == ["04"]


@pytest.mark.parametrize("channels", [4, 2])
def test_the_mask_of_a_cut_out_is_its_alpha(tmp_path: Path, channels: int) -> None:
    rng = np.random.default_rng(0)
    pixels = rng.integers(0, 60, (HEIGHT, WIDTH, 4), np.uint8)
    pixels[..., 3] = np.where(disc(), 255, 0)
    pixels[0, 0, 3], pixels[HEIGHT // 2, WIDTH // 2, 3] = 100, 200  # soft
    path = tmp_path / "mask.png"
    if channels == 2:
        image = pytest.importorskip("PIL.Image")
        image.fromarray(np.stack([pixels[..., 0], pixels[..., 3]], axis=-1), "LA").save(path)
    else:
        assert cv2.imwrite(str(path), pixels)
    np.testing.assert_array_equal(read_mask(path), disc())
    opaque = np.dstack([np.repeat(disc()[..., None] * 255, 3, 2), np.full(disc().shape, 255)])
    assert cv2.imwrite(str(path), opaque.astype(np.uint8))
    np.testing.assert_array_equal(read_mask(path), disc())


def ball(sense: int = 1, zero: float = 0.0) -> np.ndarray:
    """Stokes vectors of a ball on ``disc``: diffuse light, polarized across its outline, angles counted in a sense."""
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    outward = np.arctan2(-(y - HEIGHT / 2), x - WIDTH / 2)
    share = 0.3 * np.clip(np.hypot(y - HEIGHT / 2, x - WIDTH / 2) / (HEIGHT / 3), 0, 1) ** 2
    angle = sense * (outward - np.radians(zero))
    s0 = np.full((HEIGHT, WIDTH), 0.6)
    stokes = np.stack([s0, s0 * share * np.cos(2 * angle), s0 * share * np.sin(2 * angle)])
    return np.repeat(stokes[..., None], 3, axis=3)


@pytest.mark.parametrize(("sense", "told"), [(1, "ccw"), (-1, "cw")])
@pytest.mark.parametrize("zero", [0.0, 25.0])
def test_outlines_tell_the_sense(sense: int, told: str, zero: float) -> None:
    light = ball(sense, zero).astype(np.float32)
    agreement = outline_agreement(light, disc(), np.radians(zero))
    assert agreement is not None
    assert max(agreement.ccw, agreement.cw) > 0.9
    assert abs(min(agreement.ccw, agreement.cw)) < 0.2
    assert sense_of_outlines([agreement] * 4) == told


@pytest.mark.parametrize(
    ("views", "told"),
    [
        ([], None),
        ([(0.9, 0.0)] * 4, "ccw"),
        ([(0.0, 0.9), (0.1, 0.8), (0.1, 0.8), (0.2, 0.1)], "cw"),
        ([(0.9, 0.0), (0.0, 0.9)], None),
        ([(0.9, 0.9)] * 4, None),  # outlines along the axes
        ([(0.1, 0.0)] * 4, None),  # noise
    ],
)
def test_views_that_agree_tell_the_sense(views: list[tuple[float, float]], told: str | None) -> None:
    assert sense_of_outlines([OutlineAgreement(*view) for view in views]) == told


def measured(root: Path, given: str | None = None) -> str:
    """The sense that a dataset is read in."""
    settings = PrepareSettings(calibration=Calibration(sense=given))  # type: ignore[arg-type]
    kind = detect_dataset(root)
    assert kind is not None
    return StokesSource(open_dataset(root, kind), settings).measure(lambda count: None).sense


def test_geometry_decides_where_the_release_does_not(tmp_path: Path) -> None:
    """``write_nersp`` changes the sign of S2."""
    write_nersp(tmp_path / "cw", lambda index: ball(1))
    write_nersp(tmp_path / "ccw", lambda index: ball(-1))
    write_nersp(tmp_path / "none")
    assert measured(tmp_path / "cw") == "cw"
    assert measured(tmp_path / "ccw") == "ccw"
    with pytest.warns(PolarguideWarning, match="--sense ccw"):
        assert measured(tmp_path / "none") == "cw"
    with pytest.warns(PolarguideWarning, match="--sense ccw"):
        assert measured(tmp_path / "ccw", "cw") == "cw"
    write_pandora(tmp_path / "pandora", lambda index: ball(-1))
    with pytest.warns(PolarguideWarning, match="--sense cw"):
        assert measured(tmp_path / "pandora") == "ccw"


def test_a_sense_that_was_found_is_the_one_that_views_are_written_in(tmp_path: Path) -> None:
    write_nersp(tmp_path / "in", lambda index: ball(-1))
    source = StokesSource(open_dataset(tmp_path / "in", "nersp"), replace(PrepareSettings(), gains="none"))
    found = source.measure(lambda count: None)
    four = source.develop("0000", found).intensities
    s0, s1, s2 = ball(-1) * found.scale
    np.testing.assert_allclose(four[1] - four[3], -s2, atol=1e-5)
    np.testing.assert_allclose(four[0] - four[2], s1, atol=1e-5)
    np.testing.assert_allclose(four.sum(axis=0) / 2, s0, atol=1e-5)
