"""Camera files made from known light: mosaics in every packing, and shots through a filter."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np
from tiny_capture import encode_srgb, write_picture, write_text_model

from polarguide.geometry.polarizer import ANGLES, malus

COLOR = ("R90 R45 G90 G45", "R135 R0 G135 G0", "G90 G45 B90 B45", "G135 G0 B135 B0")
MONO = ("90 45", "135 0")


def smooth_light(height: int = 48, width: int = 64, *, peak: float = 0.8, color: bool = True) -> np.ndarray:
    """Stokes vectors [3, H, W, 3] of light that varies slowly: DoLP up to 0.5, S0/2 up to ``peak`` / 1.5."""
    y, x = np.mgrid[:height, :width] / max(height, width)
    s0 = 0.5 + 0.25 * np.sin(2.2 * x + 1.0) + 0.2 * np.cos(1.7 * y)
    s0 = s0[..., None] * (np.array([1.0, 0.8, 0.6]) if color else np.ones(3))
    dolp, aolp = 0.3 + 0.2 * np.sin(2.0 * y + x), 1.0 + 1.5 * x - y
    stokes = np.stack(
        [s0, s0 * (dolp * np.cos(2 * aolp))[..., None], s0 * (dolp * np.sin(2 * aolp))[..., None]]
    )
    return stokes * peak / 0.95


def busy_light(height: int, width: int, seed: int) -> np.ndarray:
    """Stokes vectors [3, H, W, 3] with edges, stripes and patches of polarization, as a lens would blur them."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:height, :width].astype(float)
    s0 = np.ones((height, width, 3)) * (0.6 + 0.25 * np.sin((x * x + y * y) / 700.0))[..., None]
    dolp, aolp = np.full((height, width), 0.1), x / width * np.pi
    for _ in range(20):
        center, radius = rng.uniform(0, [width, height]), rng.uniform(5, 25)
        distance = np.hypot(x - center[0], y - center[1])
        tint = rng.uniform(0.2, 0.8) * rng.uniform(0.75, 1.25, 3)  # colors of real things share their edges
        s0 = np.where((distance < radius)[..., None], tint, s0)
        dolp = np.where(distance < radius * 1.3, rng.uniform(0.05, 0.6), dolp)
        aolp = np.where(distance < radius * 1.3, np.arctan2(center[1] - y, x - center[0]), aolp)
    stokes = np.stack(
        [s0, s0 * (dolp * np.cos(2 * aolp))[..., None], s0 * (dolp * np.sin(2 * aolp))[..., None]]
    )
    return np.stack([cv2.GaussianBlur(plane, (0, 0), 0.7) for plane in stokes])


def behind(stokes: np.ndarray, degrees: Iterable[float] = ANGLES) -> np.ndarray:
    """Intensities behind ideal analyzers, [len(degrees), H, W, 3]."""
    return np.stack([malus(stokes, np.radians(angle)) for angle in degrees])


def mosaic(intensities: np.ndarray, pattern: tuple[str, ...], offset: tuple[int, int] = (0, 0)) -> np.ndarray:
    """What a sensor with ``pattern`` sees of [4, H, W, 3] from column and row ``offset`` on, sample by sample."""
    _, height, width, _ = intensities.shape
    out = np.empty((height, width))
    cells = [row.split() for row in pattern]
    for row in range(height):
        for column in range(width):
            name = cells[(row + offset[1]) % len(cells)][(column + offset[0]) % len(cells)]
            channel = "RGB".index(name[0]) if name[0] in "RGB" else 0
            out[row, column] = intensities[ANGLES.index(int(name.lstrip("RGB"))), row, column, channel]
    return out


def pack(values: np.ndarray, packing: str) -> bytes:
    """Pack by way of single bits, as the standards put it in words."""
    flat = [int(value) for value in values.ravel()]
    if packing == "16be":
        return b"".join(value.to_bytes(2, "big") for value in flat)
    bits = int(packing[:2])
    if packing.endswith(("packed", "mipi")):
        count, low = (4 if packing == "10mipi" else 2), bits - 8
        flat += [0] * (-len(flat) % count)
        out = b""
        for at in range(0, len(flat), count):
            group = flat[at : at + count]
            high = [value >> low for value in group]
            apart = 4 if packing.endswith("packed") else low
            rest = sum(value % (1 << low) << apart * place for place, value in enumerate(group))
            high.insert(1 if packing.endswith("packed") else count, rest)
            out += bytes(high)
        return out
    flat += [0] * (-len(flat) % {10: 4, 12: 2}.get(bits, 1))
    stream = [value >> bit & 1 for value in flat for bit in range(bits)]
    return bytes(sum(stream[i + bit] << bit for bit in range(8)) for i in range(0, len(stream), 8))


def write_mosaic(path: Path, values: np.ndarray, *, bits: int = 16, black: int = 0, shift: int = 0) -> None:
    """Write linear values in [0, 1] as a picture, ``.npy`` or packed file with codes up to 2^bits - 1."""
    codes = np.rint(black + np.clip(values, 0, 1) * (2**bits - 1 - black)).astype(np.uint16) << shift
    codes = codes.astype(np.uint8 if bits == 8 else np.uint16)
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".npy":
        np.save(path, codes)
    elif path.suffix.startswith(".raw"):
        path.write_bytes(pack(codes, path.suffixes[-2].strip(".")))
    else:
        assert cv2.imwrite(str(path), codes)


def write_mosaics(
    folder: Path, count: int = 3, *, color: bool = True, suffix: str = ".png", bits: int = 16
) -> np.ndarray:
    """A source folder of smooth mosaics v000, v001, ... that get darker; returns the light of the first."""
    light = smooth_light(color=color)
    for index in range(count):
        values = mosaic(behind(light) * (1 - 0.1 * index), COLOR if color else MONO)
        write_mosaic(folder / f"v{index:03d}{suffix}", values, bits=bits)
    return light


def write_shots(
    folder: Path,
    view: str,
    intensities: np.ndarray,
    *,
    suffix: str = ".png",
    bits: int = 16,
    srgb: bool = False,
) -> None:
    """Four shots ``<angle>/<view><suffix>``."""
    for angle, values in zip(ANGLES, intensities, strict=True):
        shown = encode_srgb(values) if srgb else values
        write_picture(folder / str(angle) / f"{view}{suffix}", shown, bits=bits)


def read_polar(scene: Path, view: str) -> np.ndarray:
    """The four pictures that were written, [4, H, W, 3] in [0, 1]."""
    paths = [scene / "polar" / f"{view}_{angle:03d}.png" for angle in ANGLES]
    pictures = [cv2.imread(str(path), cv2.IMREAD_UNCHANGED) for path in paths]
    assert all(picture.dtype == np.uint16 for picture in pictures)
    colored = [p[..., ::-1] if p.ndim == 3 else np.repeat(p[..., None], 3, axis=2) for p in pictures]
    return np.stack(colored) / 65535.0


def read_invalid(scene: Path, view: str) -> np.ndarray:
    """The mask of invalid pixels that was written."""
    return cv2.imread(str(scene / "invalid" / f"{view}.png"), cv2.IMREAD_UNCHANGED) > 0


def write_model(folder: Path, names: tuple[str, ...], camera: str) -> Path:
    """A text model of images ``names`` with one camera line such as "PINHOLE 32 24 40 41 16 12"."""
    write_text_model(folder, names)
    (folder / "cameras.txt").write_text(f"1 {camera}\n")
    return folder


def read_mask(scene: Path, view: str) -> np.ndarray:
    """The object mask that was written."""
    return cv2.imread(str(scene / "masks" / f"{view}.png"), cv2.IMREAD_UNCHANGED) > 0
