"""Published datasets whose cameras or numbers make no sense: what is said of each."""

from __future__ import annotations

import json
import shutil
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from dataset_files import WRITERS, disc, write_npy
from faults import Fault
from refused_preparations import refused_in_one_line as refused
from tiny_capture import write_picture

from polarguide.capture.calibration import Calibration
from polarguide.preparation.settings import PrepareSettings
from polarguide_bench.datasets.readers import open_dataset

# The light of these tests has no outlines: nothing tells the sense of NeRSP's and NeISF's angles.
pytestmark = pytest.mark.filterwarnings("ignore:The sense of .* is uncertain")
PLAIN = PrepareSettings(poses="none", gains="none")


def npz(name: str, **changes: object) -> Callable[[Path], None]:
    """Other entries in a file of arrays; None removes one."""

    def change(root: Path) -> None:
        with np.load(root / name) as file:
            arrays: dict = dict(file)
        for key, value in changes.items():
            if value is None:
                arrays.pop(key)
            else:
                arrays[key] = value(arrays[key]) if callable(value) else value
        np.savez(root / name, **arrays)

    return change


def rows(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Path], None]:
    return lambda root: np.save(root / "poses_bounds.npy", change(np.load(root / "poses_bounds.npy")))


def cameras(change: Callable[[dict], object]) -> Callable[[Path], None]:
    def rewrite(root: Path) -> None:
        content = json.loads((root / "cameras.json").read_text())
        change(content)
        (root / "cameras.json").write_text(json.dumps(content))

    return rewrite


def put(index: tuple[int, int], value: float) -> Callable[[np.ndarray], np.ndarray]:
    def change(array: np.ndarray) -> np.ndarray:
        array = np.array(array, float)
        array[index] = value
        return array

    return change


def without(array: np.ndarray) -> np.ndarray:
    return array[:-1]


def inflate(root: Path) -> None:
    with zipfile.ZipFile(root / "cameras.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("world_mat_0.npy", bytes(200_000_000))


def view(array: np.ndarray) -> np.ndarray:
    """A matrix whose rotation is none."""
    array = np.array(array, float)
    array[:3, :3] *= 2
    return array


CELLS: dict[str, tuple[str, Callable[[Path], object], Fault]] = {
    # cameras.npz
    "pandora: wrong keys": (
        "pandora", lambda d: np.savez(d / "cameras.npz", camera_mat=np.eye(4)),
        Fault("cameras.npz", "the entry world_mat_<i>", "camera_mat"),
    ),
    "pandora: no scale": (
        "pandora", npz("cameras.npz", scale_mat_2=None), Fault(expected="the entry scale_mat_2", found="and 3 more")
    ),
    "pandora: a camera too few": (
        "pandora", npz("cameras.npz", world_mat_3=None, scale_mat_3=None),
        Fault(expected="the entry world_mat_3 for view 04", found="none; 1 of 4 views"),
    ),
    "pandora: nan": (
        "pandora", npz("cameras.npz", world_mat_1=put((0, 0), np.nan)), Fault("(world_mat_1)", found="not finite")
    ),
    "pandora: singular": (
        "pandora", npz("cameras.npz", world_mat_0=np.ones((4, 4))),
        Fault(expected="that can be inverted", found="a singular one")
    ),
    "pandora: zero scale": ("pandora", npz("cameras.npz", scale_mat_0=np.zeros((4, 4))), Fault(found="a singular one")),
    "pandora: skew": (
        "pandora", npz("cameras.npz", world_mat_0=lambda m: np.array([[1, 0.3, 0, 0], *np.eye(4)[1:]]) @ m),
        Fault(expected="without skew"),
    ),
    "pandora: wrong shape": (
        "pandora", npz("cameras.npz", world_mat_0=np.eye(3)),
        Fault(expected="in shape 3x4 or 4x4", found="3x3")
    ),
    "pandora: words": ("pandora", npz("cameras.npz", world_mat_0=np.array("x")), Fault(found="a damaged one")),
    "pandora: objects": (
        "pandora", npz("cameras.npz", world_mat_0=np.array([{}], dtype=object)), Fault(found="a damaged one")
    ),
    "pandora: zip bomb": ("pandora", inflate, Fault(found="decompresses to 200000000 bytes")),
    "pandora: no cameras": (
        "pandora", lambda d: (d / "cameras.npz").unlink(),
        Fault("cameras.npz", expected="a readable file")
    ),
    # pictures
    "pandora: no part": (
        "pandora", lambda d: (d / "images_stokes" / "03_s0p2.hdr").unlink(),
        Fault(expected="the s0p2 of view 03", found="nothing")
    ),
    "pandora: no pictures": (
        "pandora", lambda d: shutil.rmtree(d / "images"),
        Fault(expected="pictures of the intrinsics", found="none")
    ),
    "pandora: another aspect": (
        "pandora", lambda d: write_picture(d / "images" / "01.png", np.ones((96, 140, 3)), bits=8),
        Fault(expected="the size of the pictures, 64x48", found="140x96"),
    ),
    "pandora: mixed sizes": (
        "pandora", lambda d: shutil.copy(
            write_hdr_of(d, 24, 32), d / "images_stokes" / "02_s0p1.hdr"
        ), Fault(expected="64x48 pixels like 02_s0.hdr", found="32x24"),
    ),
    "pandora: mask of another aspect": (
        "pandora", lambda d: write_picture(d / "mask" / "01.png", disc(48, 80).astype(float), bits=8),
        Fault("mask of view 01", expected="64x48"),
    ),
    "pandora: no files": (
        "pandora", lambda d: [p.unlink() for p in (d / "images_stokes").iterdir()],
        Fault(expected="the files of a pandora dataset")
    ),
    # NeRSP
    "nersp: whole numbers": (
        "nersp", lambda d: write_npy(d / "s0" / "0002.npy", np.ones((48, 64, 3), int)),
        Fault("0002.npy", "a picture of floating-point numbers", "int64"),
    ),
    "nersp: two channels": (
        "nersp", lambda d: write_npy(d / "s0" / "0002.npy", np.ones((48, 64, 2))), Fault(found="an array 48x64x2")
    ),
    "nersp: mixed sizes": (
        "nersp", lambda d: write_npy(d / "s1" / "0002.npy", np.ones((24, 64, 3))),
        Fault(expected="64x48 pixels like 0002.npy")
    ),
    "nersp: objects": (
        "nersp", lambda d: np.save(d / "s0" / "0002.npy", np.array([{}]), allow_pickle=True),
        Fault(expected="a complete .npy file")
    ),
    "nersp: no light": (
        "nersp", lambda d: [write_npy(p, np.zeros((48, 64, 3))) for p in d.glob("s?/*.npy")],
        Fault(expected="light in at least")
    ),
    "nersp: nothing finite": (
        "nersp", lambda d: [write_npy(p, np.full((48, 64, 3), np.nan)) for p in d.glob("s?/*.npy")],
        Fault(expected="light in")
    ),
    "nersp: missing part": (
        "nersp", lambda d: (d / "s2" / "0000.npy").unlink(),
        Fault(expected="s2 of view 0000", found="nothing")
    ),
    # NeISF
    "neisf: rows too few": ("neisf", rows(without), Fault(expected="the entry row 4 for view img_004")),
    "neisf: columns": ("neisf", rows(lambda r: r[:, :12]), Fault(expected="an array N x 17", found="4x12")),
    "neisf: nan": ("neisf", rows(put((1, 3), np.nan)), Fault("(row 1)", expected="finite numbers")),
    "neisf: no rotation": ("neisf", rows(put((2, 0), 5.0)), Fault("(row 2)", expected="a rotation")),
    "neisf: no size": (
        "neisf", rows(put((0, 4), 0.0)),
        Fault(expected="height, width and focal length in pixels", found="0, 64 and 90")
    ),
    "neisf: negative focal": ("neisf", rows(put((3, 14), -1.0)), Fault(found="48, 64 and -1")),
    # GNeRP
    "gnerp: broken json": (
        "gnerp", lambda d: (d / "cameras.json").write_text("{"),
        Fault(expected="JSON file", found="broken")
    ),
    "gnerp: bottomless json": (
        "gnerp", lambda d: (d / "cameras.json").write_text("[" * 100_000),
        Fault(expected="a JSON file")
    ),
    "gnerp: a list": ("gnerp", lambda d: (d / "cameras.json").write_text("[]"), Fault(found="[]")),
    "gnerp: degrees": (
        "gnerp", lambda d: multiply(d / "aop", 180 / np.pi),
        Fault(expected="angles in radians", found="up to")
    ),
    "gnerp: percent": (
        "gnerp", lambda d: multiply(d / "dop", 100.0),
        Fault(expected="from 0 to 1", found="a median of")
    ),
    "gnerp: no intrinsics": ("gnerp", cameras(lambda c: c.pop("intrinsic")), Fault(expected="the entry intrinsic")),
    "gnerp: no cameras": (
        "gnerp", cameras(lambda c: c.clear()),
        Fault(expected="the entry w2c_mat_<i>", found="no entry")
    ),
    "gnerp: a camera too few": (
        "gnerp", cameras(lambda c: c.pop("w2c_mat_2")),
        Fault(expected="the entry w2c_mat_2 for view 2")
    ),
    "gnerp: words": ("gnerp", cameras(lambda c: c.update(w2c_mat_1="x")), Fault("(w2c_mat_1)", found="something else")),
    "gnerp: ragged": ("gnerp", cameras(lambda c: c.update(w2c_mat_1=[[1], [2, 3]])), Fault(found="something else")),
    "gnerp: scaled pose": (
        "gnerp", cameras(lambda c: c.update(w2c_mat_1=view(np.array(c["w2c_mat_1"])).tolist())),
        Fault(expected="a rotation")
    ),
    "gnerp: negative focal": (
        "gnerp", cameras(lambda c: c["intrinsic"][0].__setitem__(0, -5)),
        Fault("(intrinsic)", expected="positive focal")
    ),
    "gnerp: aop of three channels": (
        "gnerp", lambda d: write_npy(d / "aop" / "2.npy", np.ones((48, 64, 3))),
        Fault(expected="one channel", found="an array 48x64x3")
    ),
    "gnerp: whole numbers": (
        "gnerp", lambda d: write_npy(d / "dop" / "2.npy", np.ones((48, 64), np.uint8)), Fault(found="of uint8")
    ),
    "gnerp: mixed sizes": (
        "gnerp", lambda d: write_npy(d / "dop" / "2.npy", np.ones((24, 64), np.float32)),
        Fault(expected="64x48 pixels like 2.png")
    ),
    "gnerp: missing dop": ("gnerp", lambda d: (d / "dop" / "3.npy").unlink(), Fault(expected="the DoP of view 3")),
    # PISR
    "pisr: wrong keys": (
        "pisr", lambda d: np.savez(d / "intrinsics.npz", K=np.eye(3)),
        Fault(expected="the entry camera_matrix", found="K")
    ),
    "pisr: coefficients": (
        "pisr", npz("intrinsics.npz", dist_coeffs=np.zeros(3)), Fault(expected="shape 4 or 5 or 8", found="3")
    ),
    "pisr: nan": ("pisr", npz("intrinsics.npz", dist_coeffs=np.full(5, np.nan)), Fault(found="not finite")),
    "pisr: two gammas": (
        "pisr", lambda d: (d / "gamma2.txt").touch(),
        Fault(expected="one file called gamma<number>.txt")
    ),
    "pisr: no gamma": ("pisr", lambda d: (d / "gamma1.txt").rename(d / "gammas.txt"), Fault(found="gammas.txt")),
    "pisr: no poses": (
        "pisr", lambda d: (d / "cameras_sphere.npz").unlink(),
        Fault("sphere.npz", expected="a readable")
    ),
    "pisr: float raw": (
        "pisr", lambda d: write_npy(d / "raw" / "001.npy", np.ones((256, 306))),
        Fault(expected="of 8- or 16-bit whole numbers")
    ),
    "pisr: mixed sizes": (
        "pisr", lambda d: write_npy(d / "raw" / "001.npy", np.ones((128, 306), np.uint16)),
        Fault(expected="306x256 pixels")
    ),
    "pisr: a camera too few": (
        "pisr", npz("cameras_sphere.npz", world_mat_0=None, scale_mat_0=None),
        Fault(expected="the entry world_mat_0 for view 000")
    ),
}  # fmt: skip


def multiply(folder: Path, factor: float) -> None:
    for path in folder.iterdir():
        np.save(path, np.load(path) * factor)


def write_hdr_of(root: Path, height: int, width: int) -> Path:
    from dataset_files import write_hdr

    write_hdr(root.parent / "small.hdr", np.full((height, width, 3), 0.5))
    return root.parent / "small.hdr"


@pytest.mark.parametrize("case", CELLS)
def test_datasets(tmp_path: Path, case: str) -> None:
    name, damage, fault = CELLS[case]
    if name == "neisf":
        pytest.importorskip("OpenEXR")
    source = tmp_path / "eine quelle ü"
    WRITERS[name](source)
    damage(source)
    settings = replace(PLAIN, format=name, poses="auto" if "aspect" in case else "none")
    refused(source, tmp_path / "out", settings, fault)


@pytest.mark.parametrize(
    ("name", "changes", "fault"),
    [
        (
            "nersp",
            {"sensor": "IMX250MYR"},
            Fault("--sensor", expected="the format nersp"),
        ),
        ("pandora", {"transfer": "srgb"}, Fault("--transfer", found="gnerp")),
        ("pisr", {"align": False}, Fault("--align", expected="format pisr")),
        ("gnerp", {"bits": 12}, Fault("--bits", expected="format gnerp")),
        (
            "gnerp",
            {"calibration": Calibration(gains=(1, 1, 1, 1.1))},
            Fault("calibration (gains)", expected="Stokes"),
        ),
        ("nersp", {"calibration": Calibration(sense="left")}, Fault("calibration (sense)")),
        ("nersp", {"format": "other"}, Fault("--format", "pandora", '"other"')),
        ("nersp", {"format": "pisr"}, Fault("intrinsics.npz", expected="a readable file")),
    ],
)
def test_flags(tmp_path: Path, name: str, changes: dict, fault: Fault) -> None:
    WRITERS[name](tmp_path / "in")
    refused(tmp_path / "in", tmp_path / "out", replace(PLAIN, **changes), fault)


def test_poses_of_a_dataset_are_for_datasets(tmp_path: Path) -> None:
    from camera_files import write_mosaics

    write_mosaics(tmp_path / "in")
    settings = PrepareSettings(sensor="IMX250MYR", poses="dataset")
    assert "--poses: expected sfm, none" in refused(tmp_path / "in", tmp_path / "out", settings)


@pytest.mark.parametrize(
    ("key", "value", "fault"),
    [
        ("image_width", np.array([64, 64]), Fault(expected="in shape")),
        ("image_width", np.inf, Fault(found="not finite")),
        ("image_height", -48, Fault(expected="a size in pixels")),
        ("extrinsics", np.full((4, 4, 4), np.nan), Fault(found="not finite")),
        ("extrinsics", np.full((4, 4, 4), "x"), Fault(expected="complete .npz")),
    ],
)
def test_cameras_of_phygap(tmp_path: Path, key: str, value: object, fault: Fault) -> None:
    (tmp_path / "images_full").mkdir()
    (tmp_path / "images_full" / "000.exr").touch()
    whole = {"intrinsics": np.diag([90.0, 90, 1]), "extrinsics": np.stack([np.eye(4)]), "image_width": 64}
    np.savez(tmp_path / "camera_params.npz", **{**whole, "image_height": 48, key: value})
    fault.raised_by(open_dataset, tmp_path, "phygap")
