"""Measure real single shots with known properties, and compare the results with the expected values.

    python benchmarks/accuracy/real_shots.py SHOTS --out OUT --record benchmarks/records/real-shots.json
    python benchmarks/accuracy/real_shots.py --table benchmarks/records/real-shots.json

The shots are files of other projects, and some have no license, so they are not in this repository. ``SHOTS`` has:

- ``ball``: two matt balls through a filter at six angles, and their outlines
  (Chumumu/Polarizaiton_Imaging_Aid_Coarse_Depth)
- ``sphere``: an orange, translucent sphere at four angles (ligoudaner377/polarized_inverse_scattering)
- ``color4``: two rooms at four angles, and the same rooms with a color chart (sony/dolp-colorconstancy)
- ``labels``: raw mosaics of four labeled polarizers and of a black camera (elerac/polanalyser)
- ``pot``: two views of a metal pot with a white lid, in the layout of NeISF (sony/NeISFpp)
- ``underwater``: twelve angles under a polarized lamp (MinjieWan, active polarization under water)

Most expected values were measured by hand on the same files, without this program. Their ranges contain rounding.
``docs/reference/real-shots.md`` lists the others. The pictures of all maps are in ``OUT/maps``. Angles are in degrees,
counter-clockwise as displayed.
"""

from __future__ import annotations

import argparse
import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

import polarguide as pg
from polarguide.geometry.polarizer import ANGLES

Floats = NDArray[np.floating]
Mask = NDArray[np.bool_]
CIRCLES = {
    "label 0": (192, 545, 80),
    "label 45": (501, 549, 80),
    "label 90": (777, 547, 80),
    "label 135": (1055, 555, 75),
}
"""Column, row and radius inside the polarizers of ``labels``, in pixels of half the size of the sensor."""
SPHERE = (108.6, 139.2, 75.6)
"""Column, row and radius of the sphere."""
GRAY = {"scene000": (247, 207, 26, 21), "scene003": (285, 220, 7, 6)}
"""Left column, top row, width and height of a gray patch of the color chart."""


YES_OR_NO = "yes or no"
"""Unit of a quantity that is 1 for yes and 0 for no."""


@dataclass(frozen=True)
class Row:
    """One quantity of the shots in a folder.

    Attributes:
        shots: name of the folder.
        quantity: name of the quantity.
        unit: "degrees", "%", empty for numbers from 0 to 1, or ``YES_OR_NO`` for 1 and 0.
        low: smallest expected value.
        high: largest expected value.
        measured: value that polarguide gives.
    """

    shots: str
    quantity: str
    unit: str
    low: float
    high: float
    measured: float

    @property
    def agrees(self) -> bool:
        """True if the measured value, rounded as in the table, is in the expected range."""
        digits = 1 if self.unit else 3
        return self.low <= round(self.measured, digits) <= self.high

    def cells(self) -> list[str]:
        """Return the cells of the table."""
        low, high, measured = map(self._text, (self.low, self.high, self.measured))
        quantity = f"{self.quantity} ({self.unit})" if self.unit in ("degrees", "%") else self.quantity
        expected = low if low == high else f"{low} to {high}"
        return [f"`{self.shots}`", quantity, expected, measured, "yes" if self.agrees else "**no**"]

    def _text(self, value: float) -> str:
        if self.unit == YES_OR_NO:
            return "yes" if value else "no"
        return f"{value:.1f}" if self.unit else f"{value:.3f}"


def polar_offset(maps: pg.ShotMaps, circle: tuple[float, float, float]) -> tuple[Floats, Floats, Floats]:
    """Return the angles between the AoLP and the directions from the center of a circle.

    Returns:
        Phasors ``exp(2i (AoLP - direction))`` [H, W]; the same for angles that count clockwise; and the distance from
        the center [H, W] in radii.
    """
    column, row, radius = circle
    rows, columns = np.mgrid[: maps.size[1], : maps.size[0]]
    direction = np.arctan2(row - rows, columns - column)
    distance = np.hypot(rows - row, columns - column) / radius
    return np.exp(2j * (maps.aolp - direction)), np.exp(2j * (-maps.aolp - direction)), distance


def mean_degrees(phasors: Floats) -> float:
    """Return the mean angle of doubled phasors, in degrees from -90 to 90."""
    return float(np.degrees(np.angle(phasors.mean())) / 2)


def contradiction(maps: pg.ShotMaps) -> float:
    """Return the largest difference in degrees between stated and reported angles of a set; 0 without reports."""
    differences = [
        abs((fit.looks_like - fit.angle + 90) % 180 - 90)
        for fit in maps.pictures
        if fit.looks_like is not None
    ]
    return max(differences, default=0.0)


def ball(folder: Path) -> Iterator[Row]:
    """Measure the matt balls: radial AoLP, its zero and spread, and the pair sums."""
    circles = json.loads((folder / "ball_circles.json").read_text())["circles_cx_cy_r_px"]
    maps = pg.read_shot(folder)
    parts = [polar_offset(maps, circle) for circle in circles]

    def ring(index: int, low: float, high: float) -> Floats:
        return np.concatenate([part[index][(part[2] >= low) & (part[2] < high)] for part in parts])

    edges = np.linspace(0.5, 0.95, 9)
    offsets = [mean_degrees(ring(0, low, high)) for low, high in pairwise(edges)]
    zero = float(np.mean(offsets))
    yield Row("ball", "agreement with the radial direction", "", 0.9, 1.0, abs(ring(0, 0.5, 0.95).mean()))
    yield Row("ball", "the same, angles clockwise", "", 0.0, 0.2, abs(ring(1, 0.5, 0.95).mean()))
    yield Row("ball", "offset of the zero", "degrees", 1.8, 2.6, abs(zero))
    for low, high, expected in ((0.85, 0.95, 2.0), (0.5, 0.7, 4.0)):
        angles = np.degrees(np.angle(ring(0, low, high) * np.exp(-2j * np.radians(zero)))) / 2
        name = f"median deviation at {low} to {high} of the radius"
        yield Row("ball", name, "degrees", expected - 0.5, expected + 0.5, float(np.median(np.abs(angles))))
    pictures = {int(path.stem): cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in folder.glob("*.bmp")}
    sums = np.stack([pictures[a].astype(float) + pictures[a + 90] for a in (10, 40, 70)])
    brightest = np.max([*pictures.values()], axis=0)
    glare = (brightest > 20) & (brightest < 100)
    balls = np.any([part[2] < 0.9 for part in parts], axis=0)
    for name, mask in (("in the glare of the lamp", glare), ("on the balls", balls)):
        drift = np.ptp(np.median(sums[:, mask], axis=1)) / np.median(sums[:, mask])
        yield Row("ball", f"drift of the pair sums {name}", "%", 3.5, 4.5, 100 * float(drift))
    rows, columns = np.nonzero(balls)
    crop = np.s_[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]
    angles = sorted(pictures)
    cropped = pg.read_shot(np.stack([pictures[angle][crop] for angle in angles]), angles=angles)
    yield Row("ball", "largest error of a reported angle, balls", "degrees", 0, 2, contradiction(cropped))
    yield Row("ball", "the same, whole picture with the lamp", "degrees", 0, 2, contradiction(maps))


def sphere(folder: Path) -> Iterator[Row]:
    """Measure the translucent sphere: tangential AoLP and pair sums."""
    maps = pg.read_shot(folder)
    ccw, cw, distance = polar_offset(maps, SPHERE)
    weight = maps.dolp * (maps.usable & (distance < 1))
    radial, opposite = ((weight * phasors).sum() / weight.sum() for phasors in (ccw, cw))
    stored = pg.read_shot(folder, pg.ShotOptions(transfer="linear"))
    yield Row("sphere", "angle from the radial direction", "degrees", 88.7, 90.7, abs(mean_degrees(radial)))
    yield Row("sphere", "agreement with this angle, weighted by DoLP", "", 0.82, 0.92, abs(radial))
    yield Row("sphere", "the same, angles clockwise", "", 0.0, 0.17, abs(opposite))
    yield Row("sphere", "pair sums of the stored values", "%", -1.2, -1.0, 100 * (stored.pair_ratio - 1))
    yield Row("sphere", "pair sums of the decoded light", "%", -2.7, -0.2, 100 * (maps.pair_ratio - 1))


def color4(folder: Path) -> Iterator[Row]:
    """Measure the rooms: pair sums, DoLP, and the color of the separated gloss compared with the light."""
    for name, (left, top, width, height) in GRAY.items():
        maps = pg.read_shot([folder / f"{name}_i{angle:03d}.png" for angle in ANGLES])
        yield Row("color4", f"{name}: pair sums", "%", -2.6, -2.2, 100 * (maps.pair_ratio - 1))
        dolp = float(np.median(maps.dolp[maps.measured]))
        yield Row("color4", f"{name}: median DoLP", "", 0.010, 0.040, dolp)
        chart = cv2.imread(str(folder / f"{name}_macbeth.png"), cv2.IMREAD_UNCHANGED)[..., ::-1]
        gray = chart[top : top + height, left : left + width].mean(axis=(0, 1))
        whole = maps.intensities.mean(axis=0)[maps.measured].sum(axis=0)
        gloss = pg.surface_maps(maps).specular_paper[maps.usable].sum(axis=0)
        yield Row(
            "color4",
            f"{name}: color of the gloss against the gray patch",
            "degrees",
            0,
            color_angle(whole, gray),
            color_angle(gloss, gray),
        )


def color_angle(color: Floats, other: Floats) -> float:
    """Return the angle in degrees between two colors [3] as vectors."""
    cosine = np.dot(color, other) / np.linalg.norm(color) / np.linalg.norm(other)
    return float(np.degrees(np.arccos(cosine)))


def labels(folder: Path) -> Iterator[Row]:
    """Measure the labeled polarizers and the black camera."""
    options = pg.ShotOptions(sensor="IMX250MZR", demosaic="half")
    maps = pg.read_shot(folder / "polarizer_IMX250MZR.png", options)
    rows, columns = np.mgrid[: maps.size[1], : maps.size[0]]
    known = ((83.4, 0.52), (43.6, 0.42), (175.2, 0.39), (135.5, 0.42))
    for (name, (column, row, radius)), (angle, degree) in zip(CIRCLES.items(), known, strict=True):
        inside = maps.usable & (np.hypot(rows - row, columns - column) < radius)
        aolp = mean_degrees(np.exp(2j * maps.aolp[inside])) % 180
        yield Row("labels", f"{name}: AoLP", "degrees", angle - 0.5, angle + 0.5, aolp)
        dolp = float(np.median(maps.dolp[inside]))
        yield Row("labels", f"{name}: median DoLP", "", degree - 0.01, degree + 0.01, dolp)
    yield Row("labels", "polarizers: pair sums", "%", -1.3, -0.9, 100 * (maps.pair_ratio - 1))
    camera = pg.read_shot(folder / "camera_IMX250MZR.png", options)
    yield Row("labels", "camera: pair sums", "%", -2.3, -1.9, 100 * (camera.pair_ratio - 1))
    for percentile, degree, tolerance in ((50, 0.03, 0.01), (90, 0.36, 0.02), (99, 0.77, 0.03)):
        dolp = float(np.percentile(camera.dolp[camera.measured], percentile))
        name = f"camera: DoLP, percentile {percentile}"
        yield Row("labels", name, "", degree - tolerance, degree + tolerance, dolp)


def pot(folder: Path, out: Path) -> Iterator[Row]:
    """Prepare the two views of the pot, and measure the DoLP of metal and lid and the sense of the angles."""
    pg.prepare(folder, out)
    notes = " ".join(json.loads((out / "scene.json").read_text())["notes"])
    agreement = re.search(r"masks: (-?[\d.]+) counter-clockwise, (-?[\d.]+) clockwise", notes)
    assert agreement is not None
    ccw, cw = map(float, agreement.groups())
    yield Row("pot", "agreement with the outlines", "", 0.57, 0.61, ccw)
    yield Row("pot", "the same, angles clockwise", "", -0.15, -0.11, cw)
    for view in pg.load_scene(out).views:
        maps = pg.read_shot(view)
        metal = bright(folder / "c_masks" / f"{view.name}.png")
        inside = bright(folder / "masks" / f"{view.name}.png")
        for name, mask, low, high in (
            ("metal", metal & inside, 0.175, 0.205),
            ("lid", inside & ~metal, 0.0105, 0.0125),
        ):
            green = maps.intensities[:, mask & maps.measured, 1]
            degree = float(
                np.median(np.hypot(green[0] - green[2], green[1] - green[3]) / green.sum(axis=0) * 2)
            )
            yield Row("pot", f"{view.name}, {name}: median DoLP of green", "", low, high, degree)


def bright(path: Path) -> Mask:
    """Read the white part of a picture as a mask [H, W]."""
    pixels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    return np.asarray(pixels[..., 0] > pixels.max() / 2)


def underwater(folder: Path, out: Path) -> Iterator[Row]:
    """Measure the set of twelve angles: residual, DoLP, and the warning about polarized light."""
    maps = pg.read_shot(folder)
    paths = {int(path.stem.partition("_a")[2]): path for path in folder.glob("*.bmp")}
    rows = np.stack([[1, np.cos(2 * t), np.sin(2 * t)] for t in np.radians(sorted(paths))]) / 2
    pictures = np.stack([cv2.imread(str(paths[a]), cv2.IMREAD_GRAYSCALE) for a in sorted(paths)]) / 255
    residual = np.sqrt(((pictures - np.einsum("ki,ihw->khw", rows, maps.stokes)) ** 2).mean(axis=0))
    share = float(np.median((residual / (maps.s0 / 2))[maps.measured]))
    yield Row("underwater", "residual relative to S0/2", "%", 1.4, 2.0, 100 * share)
    yield Row("underwater", "median DoLP", "", 0.48, 0.68, float(np.median(maps.dolp[maps.measured])))
    four = linked({f"view_{angle}": paths[angle] for angle in ANGLES}, out / "underwater-four")
    for name, source in (("four of the angles", four), ("twelve angles", folder)):
        scene = out / f"{source.name}-scene"
        pg.prepare(source, scene, pg.PrepareSettings(poses="none"))
        checks = pg.inspect(scene).checks
        warned = any(check.key == "dielectric" and check.verdict == "warning" for check in checks)
        yield Row("underwater", f"`inspect` warns of polarized light, {name}", YES_OR_NO, 1, 1, int(warned))


def linked(files: Mapping[str, Path], folder: Path) -> Path:
    """Create a folder of links to files, whose names state the angles of the filter as polarguide reads them."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, path in files.items():
        link = folder / f"{name}{path.suffix}"
        link.unlink(missing_ok=True)
        link.symlink_to(path.resolve())
    return folder


def measure(shots: Path, out: Path) -> list[Row]:
    """Measure all folders, and write the pictures of their maps to ``OUT/maps``."""
    turned = {
        f"view_a{path.stem.removesuffix('_c')}": path for path in shots.glob("underwater/Scene1_LT/*.bmp")
    }
    water = linked(turned, out / "underwater-twelve")
    orange = linked({f"view_{angle}": shots / "sphere" / f"p{angle}.png" for angle in ANGLES}, out / "sphere")
    rows = [
        *ball(shots / "ball"),
        *sphere(orange),
        *color4(shots / "color4"),
        *labels(shots / "labels"),
        *pot(shots / "pot", out / "pot"),
        *underwater(water, out),
    ]
    for folder in (shots / "ball", orange, water, out / "pot"):
        pictures = out / "maps" / folder.name
        if (folder / "sparse").exists():
            pg.priors(folder, pictures, views="all", formats=("png",))
        else:
            pg.shot_priors(folder, pictures, formats=("png",))
    mosaics = pg.ShotOptions(sensor="IMX250MZR", demosaic="half")
    pg.shot_priors(shots / "labels", out / "maps" / "labels", shots=mosaics, formats=("png",))
    for name in GRAY:
        files = [shots / "color4" / f"{name}_i{angle:03d}.png" for angle in ANGLES]
        pg.shot_priors(files, out / "maps" / name, formats=("png",))
    return rows


def table(rows: list[Row]) -> str:
    """Return the table of expected and measured values in Markdown."""
    lines = [["shots", "quantity", "expected", "measured", "agrees"], ["---", "---", "---", "---:", "---"]]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in [*lines, *(row.cells() for row in rows)])


def read_rows(path: Path) -> list[Row]:
    """Read the rows of a record."""
    return [Row(**row) for row in json.loads(path.read_text())]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("shots", type=Path, nargs="?", help="folder of the shots")
    parser.add_argument("--out", type=Path, help="folder for pictures and prepared scenes")
    parser.add_argument("--record", type=Path, help="file to write")
    parser.add_argument("--table", type=Path, help="print the table of this record, and measure nothing")
    options = parser.parse_args()
    if options.table is not None:
        print(table(read_rows(options.table)))
        return
    if options.shots is None or options.out is None:
        parser.error("expected SHOTS and --out OUT, or --table RECORD")
    rows = measure(options.shots, options.out)
    print(table(rows))
    if options.record is not None:
        options.record.write_text(json.dumps([asdict(row) for row in rows], indent=1) + "\n")


if __name__ == "__main__":
    main()
