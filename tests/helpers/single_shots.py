"""The demo as if it had been captured with one picture a view."""

from __future__ import annotations

import shutil
from pathlib import Path


def single_shots(demo: Path, out: Path, *, wrong: tuple[int, ...] = ()) -> Path:
    """One picture of every view of the demo; lines of some are 90 degrees off."""
    (out / "polar").mkdir(parents=True)
    shutil.copytree(demo / "sparse", out / "sparse")
    lines = ["file,view,angle"]
    names = sorted(path.name[:-8] for path in (demo / "polar").glob("*_000.png"))
    for k, name in enumerate(names):
        angle = (0, 45, 90, 135, 90, 0)[k % 6]
        shutil.copy(demo / "polar" / f"{name}_{angle:03d}.png", out / "polar" / f"{name}.png")
        lines.append(f"{name}.png,{name},{(angle + 90 * (k in wrong)) % 180}")
    (out / "angles.csv").write_text("\n".join(lines) + "\n")
    return out
