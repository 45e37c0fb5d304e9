"""Folders in the layouts of published datasets, written from known light and known cameras."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
from camera_files import COLOR, behind, mosaic, smooth_light
from tiny_capture import encode_srgb, write_picture

HEIGHT, WIDTH = 48, 64
INNER = np.array([[90.0, 0, 33], [0, 92, 23], [0, 0, 1]])
VIEWS = 4
DISTORTION = (0.06, -0.03, 0.002, -0.001, 0.02)
SCALE = np.array([[2.0, 0, 0, 0.1], [0, 2, 0, -0.2], [0, 0, 2, 0.3], [0, 0, 0, 1]])
"""Scene units of an object in the unit sphere, as scale_mat has it."""


def poses() -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """World-to-camera rotations and translations of cameras on an arc that look at the origin."""
    for angle in np.radians([-30, -10, 10, 35]):
        center = 3 * np.array([np.sin(angle), -0.3, -np.cos(angle)])
        forward = -center / np.linalg.norm(center)
        right = np.cross([0, 1.0, 0], forward)
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(forward, right), forward])
        yield rotation, -rotation @ center


def light_of(index: int) -> np.ndarray:
    """Stokes vectors of a view, [3, H, W, 3]."""
    return smooth_light(HEIGHT, WIDTH) * (1 - 0.1 * index)


def disc(height: int = HEIGHT, width: int = WIDTH) -> np.ndarray:
    """The object mask of all views."""
    y, x = np.mgrid[:height, :width]
    return np.hypot(y - height / 2, x - width / 2) < height / 3


def idr_cameras(inner: np.ndarray = INNER) -> dict[str, np.ndarray]:
    """world_mat and scale_mat; one matrix has another sign and scale, which mean nothing."""
    arrays = {}
    for index, (rotation, translation) in enumerate(poses()):
        projection = np.eye(4)
        projection[:3] = inner @ np.column_stack([rotation, translation])
        arrays[f"world_mat_{index}"] = projection @ np.linalg.inv(SCALE) * (-3.7 if index == 1 else 1.0)
        arrays[f"scale_mat_{index}"] = SCALE
    return arrays


def write_hdr(path: Path, rgb: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), rgb[..., ::-1].astype(np.float32))


def write_npy(path: Path, array: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    np.save(path, array)


def write_pandora(root: Path, light: Callable[[int], np.ndarray] = light_of) -> Path:
    """HDR files of twice the light; intrinsics for RGB pictures of twice the size."""
    for index in range(VIEWS):
        s0, s1, s2 = light(index)
        name = f"{index + 1:02d}"
        write_hdr(root / "images_stokes" / f"{name}_s0.hdr", 2 * s0)
        write_hdr(root / "images_stokes" / f"{name}_s0p1.hdr", 2 * (s0 + s1))
        write_hdr(root / "images_stokes" / f"{name}_s0p2.hdr", 2 * (s0 + s2))
        write_picture(root / "images" / f"{name}.png", np.full((2 * HEIGHT, 2 * WIDTH, 3), 0.5), bits=8)
        write_picture(root / "mask" / f"{name}.png", disc().astype(float), bits=8)
    np.savez(root / "cameras.npz", **idr_cameras(np.diag([2, 2, 1]) @ INNER))
    return root


def write_nersp(root: Path, light: Callable[[int], np.ndarray] = light_of) -> Path:
    """Twice the light, angles with y down: S2 has the other sign."""
    for index in range(VIEWS):
        name = f"{index:04d}"
        for part, plane, sign in zip(("s0", "s1", "s2"), light(index), (1, 1, -1), strict=True):
            write_npy(root / part / f"{name}.npy", 2.0 * sign * plane)
        write_picture(root / "image" / f"{name}.png", np.full((HEIGHT, WIDTH, 3), 0.5), bits=8)
        angles = np.zeros((HEIGHT, WIDTH, 4), np.uint16)
        angles[..., 3] = disc() * 65535
        (root / "input_azimuth_maps").mkdir(exist_ok=True)
        assert cv2.imwrite(str(root / "input_azimuth_maps" / f"{name}.png"), angles)
    np.savez(root / "cameras.npz", **idr_cameras())
    return root


def write_neisf(root: Path, light: Callable[[int], np.ndarray] = light_of) -> Path:
    """EXR files; one focal length, the principal point in the middle; axes down, right, back."""
    import OpenEXR

    rows = []
    for index, (rotation, translation) in enumerate(poses()):
        name = f"img_{index + 1:03d}"
        for part, plane in zip(("s0", "s1", "s2"), light(index), strict=True):
            (root / f"images_{part}").mkdir(parents=True, exist_ok=True)
            header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
            channels = {"RGB": np.ascontiguousarray(plane, np.float32)}
            OpenEXR.File(header, channels).write(str(root / f"images_{part}" / f"{name}.exr"))
        write_picture(root / "masks" / f"{name}.png", np.repeat(disc()[..., None], 3, 2).astype(float))
        right, down, forward = rotation
        matrix = np.stack([down, right, -forward, -rotation.T @ translation, [HEIGHT, WIDTH, 90.0]], axis=1)
        rows.append([*matrix.ravel(), 0.1, 9.0])
    np.save(root / "poses_bounds.npy", np.array(rows))
    return root


def write_gnerp(root: Path, light: Callable[[int], np.ndarray] = light_of) -> Path:
    """Display-encoded S0 / 2; angle and degree of polarization of the green channel."""
    content: dict[str, object] = {"intrinsic": INNER.tolist()}
    for index, (rotation, translation) in enumerate(poses()):
        s0, s1, s2 = light(index)
        write_picture(root / "images" / f"{index}.png", encode_srgb(s0 / 2), bits=8)
        write_npy(root / "aop" / f"{index}.npy", (np.arctan2(s2, s1) / 2)[..., 1].astype(np.float32))
        write_npy(root / "dop" / f"{index}.npy", (np.hypot(s1, s2) / s0)[..., 1].astype(np.float32))
        write_picture(root / "masks" / f"{index}.png", disc().astype(float), bits=8)
        rigid = np.eye(4)
        rigid[:3] = np.column_stack([rotation, translation])
        content[f"w2c_mat_{index}"] = rigid.tolist()
    (root / "cameras.json").write_text(json.dumps(content))
    return root


def write_pisr(
    root: Path,
    light: Callable[[int], np.ndarray] | None = None,
    *,
    gamma: float = 1.0,
    distortion: tuple[float, ...] = DISTORTION,
) -> Path:
    """12-bit mosaics of 306x256; intrinsics of OpenCV at 1224x1024, eight times the size of a developed picture."""
    for index in range(VIEWS):
        stokes = smooth_light(256, 306) * (1 - 0.1 * index) if light is None else light(index)
        codes = np.rint(mosaic(behind(stokes), COLOR) ** gamma * 4095).astype(np.uint16)
        write_npy(root / "raw" / f"{index:03d}.npy", codes)
        write_picture(root / "mask" / f"{index:03d}.png", disc(128, 153).astype(float), bits=8)
    np.savez(root / "intrinsics.npz", camera_matrix=pisr_inner(), dist_coeffs=np.array([distortion]))
    np.savez(root / "cameras_sphere.npz", **idr_cameras(pisr_inner()))
    (root / f"gamma{gamma:g}.txt").touch()
    return root


def pisr_inner() -> np.ndarray:
    """Intrinsics at 1224x1024 as OpenCV has them, counted from the center of the first pixel."""
    return np.array([[1500.0, 0, 620], [0, 1510, 500], [0, 0, 1]])


def write_phygap(root: Path, light: Callable[[int], np.ndarray] = light_of) -> Path:
    """EXR files with the channels of Mitsuba, whose angles count from the vertical; cameras in one file."""
    import OpenEXR

    poses_ = []
    for index, (rotation, translation) in enumerate(poses()):
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        channels = {}
        for part, plane, sign in zip(range(3), light(index), (1, -1, -1), strict=True):
            for c, color in enumerate("RGB"):
                channels[f"S{part}.{color}"] = np.ascontiguousarray(sign * plane[..., c], np.float32)
        (root / "images_full").mkdir(parents=True, exist_ok=True)
        OpenEXR.File(header, channels).write(str(root / "images_full" / f"{index:03d}.exr"))
        write_picture(root / "masks" / f"{index:03d}.png", disc().astype(float), bits=8)
        rigid = np.eye(4)
        rigid[:3] = np.column_stack([rotation, translation])
        poses_.append(rigid)
    np.savez(
        root / "camera_params.npz",
        intrinsics=INNER, extrinsics=np.stack(poses_), image_width=WIDTH, image_height=HEIGHT, fov=30.0,
    )  # fmt: skip
    return root


WRITERS: dict[str, Callable[[Path], Path]] = {
    "pandora": write_pandora,
    "pisr": write_pisr,
    "nersp": write_nersp,
    "neisf": write_neisf,
    "gnerp": write_gnerp,
    "phygap": write_phygap,
}
