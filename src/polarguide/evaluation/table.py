"""What the tables of a comparison show: one row of data for each column."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Direction = Literal["higher", "lower"]


@dataclass(frozen=True)
class Column:
    """One quantity of a run.

    Attributes:
        key: its name in ``metrics.json``.
        label: heading. unit: after it, in brackets; empty for none.
        digits: decimal places shown.
        better: which direction is better; None: neither, and nothing is set in bold.
        shown: whether Markdown, LaTeX and the report have it (CSV and JSON have all).
        speed: whether it counts only when measured alone; such a value may be absent without a fault.
        factor: what the value is multiplied with before it is shown.
    """

    key: str
    label: str
    unit: str
    digits: int
    better: Direction | None
    shown: bool = True
    speed: bool = False
    factor: float = 1.0

    @property
    def arrow(self) -> str:
        """Points to the better side; empty where there is none."""
        return {"higher": "↑", "lower": "↓", None: ""}[self.better]

    @property
    def heading(self) -> str:
        """Label, unit and arrow."""
        return " ".join(filter(None, (self.label, f"({self.unit})" if self.unit else "", self.arrow)))


COLUMNS: tuple[Column, ...] = (
    Column("psnr", "PSNR", "dB", 2, "higher"),
    Column("psnr_foreground", "PSNR foreground", "dB", 2, "higher"),
    Column("psnr_reflective", "PSNR reflective", "dB", 2, "higher"),
    Column("ssim", "SSIM", "", 3, "higher"),
    Column("lpips", "LPIPS", "", 3, "lower"),
    Column("normal_mae_deg", "normal error", "deg", 1, "lower"),
    Column("normal_within_11", "within 11.25 deg", "%", 1, "higher", factor=100.0),
    Column("specular_psnr", "specular PSNR", "dB", 2, "higher"),
    Column("diffuse_psnr", "diffuse PSNR", "dB", 2, "higher"),
    Column("specular_psnr_aligned", "specular PSNR aligned", "dB", 2, "higher", shown=False),
    Column("diffuse_psnr_aligned", "diffuse PSNR aligned", "dB", 2, "higher", shown=False),
    Column("gaussians", "Gaussians", "", 0, None),
    Column("fps", "FPS", "", 1, "higher", speed=True),
    Column("fps_layers", "FPS all layers", "", 1, "higher", shown=False, speed=True),
    Column("train_seconds", "training", "s", 0, "lower", speed=True),
)
KEYS: tuple[str, ...] = tuple(column.key for column in COLUMNS)
