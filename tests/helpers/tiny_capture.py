"""A tiny valid capture, written file by file, that the tests then damage in one place each."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from polarguide.geometry.polarizer import ANGLES

HEIGHT, WIDTH = 10, 12
NAMES = tuple(f"v{index:03d}" for index in range(9))


def ideal_intensities(
    seed: int, *, dolp: float = 0.6, height: int = HEIGHT, width: int = WIDTH
) -> np.ndarray:
    """Intensities behind an ideal analyzer, [4, H, W, 3] in [0.02, 0.8], of random partly polarized light."""
    rng = np.random.default_rng(seed)
    s0 = rng.uniform(0.3, 0.9, (height, width, 3))
    degree = rng.uniform(0.0, dolp, (height, width, 1))
    angle = rng.uniform(0.0, np.pi, (height, width, 1))
    theta = np.radians(ANGLES)[:, None, None, None]
    return 0.5 * s0 * (1.0 + degree * np.cos(2.0 * (theta - angle)))


def encode_srgb(linear: np.ndarray) -> np.ndarray:
    return np.where(
        linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055
    )


def write_picture(path: Path, values: np.ndarray, *, bits: int = 16) -> None:
    """Write values in [0, 1], RGB or gray."""
    full = 2**bits - 1
    stored = np.rint(np.clip(values, 0.0, 1.0) * full).astype(np.uint8 if bits == 8 else np.uint16)
    path.parent.mkdir(parents=True, exist_ok=True)
    options = [cv2.IMWRITE_JPEG_QUALITY, 100] if path.suffix.lower() in (".jpg", ".jpeg") else []
    assert cv2.imwrite(str(path), stored[..., ::-1] if stored.ndim == 3 else stored, options)


@dataclass
class TinyCapture:
    """The folder of a capture and the intensities that were written into it, view name -> [4, H, W, 3]."""

    root: Path
    linear: dict[str, np.ndarray] = field(default_factory=dict)

    def picture(self, view: str, angle: int, suffix: str = ".png") -> Path:
        return self.root / "polar" / f"{view}_{angle:03d}{suffix}"

    def write_view(self, view: str, values: np.ndarray, *, bits: int = 16, suffix: str = ".png") -> None:
        """Write the four pictures of one view as they are to be stored."""
        for angle, value in zip(ANGLES, values, strict=True):
            write_picture(self.picture(view, angle, suffix), value, bits=bits)

    def rewrite(
        self, change: Callable[[np.ndarray], np.ndarray], *, bits: int = 16, suffix: str = ".png"
    ) -> None:
        """Replace all pictures by a function of their linear intensities."""
        for path in (self.root / "polar").iterdir():
            path.unlink()
        for view, linear in self.linear.items():
            self.write_view(view, change(linear), bits=bits, suffix=suffix)

    def to_folders(self, folders: tuple[str, str, str, str]) -> None:
        """Move the pictures into one folder per angle."""
        for angle, folder in zip(ANGLES, folders, strict=True):
            (self.root / folder).mkdir()
            for path in sorted((self.root / "polar").glob(f"*_{angle:03d}.*")):
                path.rename(self.root / folder / (path.stem[:-4] + path.suffix))
        (self.root / "polar").rmdir()

    def write_json(self, name: str, content: object) -> Path:
        path = self.root / name
        path.write_text(json.dumps(content))
        return path

    def write_cameras(self, line: str) -> None:
        (self.root / "sparse" / "0" / "cameras.txt").write_text(line + "\n")

    def write_truth(self, view: str, **arrays: np.ndarray) -> Path:
        path = self.root / "gt" / f"{view}.npz"
        path.parent.mkdir(exist_ok=True)
        np.savez_compressed(path, **arrays)
        return path


def write_text_model(folder: Path, names: tuple[str, ...]) -> None:
    """Views on a line, looking along +z after a quarter turn about z in every odd view; four points."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "cameras.txt").write_text(f"# one camera\n1 PINHOLE {WIDTH} {HEIGHT} 15.5 15.25 6.5 4.75\n")
    half = np.sqrt(0.5)
    lines = []
    for index, name in enumerate(names):
        quaternion = f"{half:.17g} 0 0 {half:.17g}" if index % 2 else "1 0 0 0"
        lines.append(f"{index + 1} {quaternion} {0.1 * index} -0.25 2.5 1 {name}.png\n\n")
    (folder / "images.txt").write_text("".join(lines))
    (folder / "points3D.txt").write_text(
        "7 0.5 0.25 1.5 10 20 30 0.5\n2 -1 0 2 255 0 128 0.5\n3 0 0 3 1 2 3 0.5\n4 1 1 1 4 5 6 0.5\n"
    )


def write_tiny_capture(root: Path) -> TinyCapture:
    """A valid capture of nine views of 12x10 pixels: 16-bit PNG, text model, nothing optional."""
    tiny = TinyCapture(root)
    for index, name in enumerate(NAMES):
        tiny.linear[name] = ideal_intensities(index)
        tiny.write_view(name, tiny.linear[name])
    write_text_model(root / "sparse" / "0", NAMES)
    return tiny
