"""Draw the figures of docs/explanation/method.md with the functions of the training.

    python benchmarks/accuracy/method_figures.py

Writes docs/images/method-dolp.png (Fresnel's equations over the zenith), method-ambiguity.png (the candidates of a
pixel, and the choice of a guide) and method-separation.png (the layers of a measured view next to the true layers).
"""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl
import torch
from matplotlib import pyplot
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from result_figures import COLORS, STYLE
from torch import Tensor

import polarguide as pg
from polarguide.capture import View
from polarguide.visualization.figures import aolp_to_rgb, radiance_to_rgb

IMAGES = Path(__file__).resolve().parents[2] / "docs" / "images"
VIEW, DEGREE, INDEX = "v022", 0.2, 1.5
"""View of the demo scene; degree of polarization with marked zeniths; refractive index."""
TILT = 0.35
"""Angle between the example's guide and the true normal, about the picture's vertical axis (20 degrees)."""
FAINT = 0.03
"""DoLP below which the example has no azimuth."""


def save(figure: Figure, name: str) -> None:
    """Write a figure to docs/images."""
    figure.savefig(IMAGES / f"method-{name}.png", dpi=130, metadata={"Software": None})
    pyplot.close(figure)


def draw_dolp() -> None:
    """Draw the DoLP of both lobes over the zenith, and the three zeniths of one degree."""
    figure, axis = pyplot.subplots(figsize=(6.4, 3.1), layout="constrained")
    zenith = torch.linspace(0, torch.pi / 2, 400, dtype=torch.float64)
    below, above = pg.optics.specular_zeniths(torch.tensor(DEGREE, dtype=torch.float64), INDEX)
    diffuse = pg.optics.diffuse_zenith(torch.tensor(DEGREE, dtype=torch.float64), INDEX)
    axis.plot(zenith.rad2deg(), pg.optics.specular_dolp(zenith, INDEX), color=COLORS[2], label="specular")
    axis.plot(zenith.rad2deg(), pg.optics.diffuse_dolp(zenith, INDEX), color=COLORS[1], label="diffuse")
    axis.axhline(DEGREE, color=COLORS[0], linewidth=0.8, linestyle=":")
    for angle, color, side in (
        (below, COLORS[2], "right"),
        (diffuse, COLORS[1], "right"),
        (above, COLORS[2], "left"),
    ):
        axis.plot(angle.rad2deg(), DEGREE, "o", color=color)
        axis.annotate(
            f" {angle.rad2deg():.0f}° ", (float(angle.rad2deg()), DEGREE + 0.03), ha=side, color=color
        )
    brewster = float(torch.as_tensor(pg.optics.brewster(INDEX)).rad2deg())
    axis.annotate(f"Brewster's angle, {brewster:.1f}°", (brewster + 6, 0.99), color=COLORS[2])
    axis.set(xlabel="zenith of the normal (degrees)", ylabel="DoLP", xlim=(0, 90), ylim=(0, 1.05))
    axis.legend(loc="center left", frameon=False)
    save(figure, "dolp")


def draw_candidates(axis: Axes, stokes: Tensor, guide: Tensor, ray: Tensor) -> None:
    """Draw the six candidates of a pixel along its ray: angle is the azimuth, radius the zenith."""
    found = pg.optics.physical_candidates(stokes, ray, INDEX)
    chosen = int(pg.optics.disambiguate(found, guide, ray, azimuth_weight=1.0).choice)
    azimuth, zenith = pg.optics.azimuth(found.normals, ray), pg.optics.zenith(found.normals, ray).rad2deg()
    for kind, color, label in ((True, COLORS[2], "specular"), (False, COLORS[1], "diffuse")):
        these = found.valid & (found.specular == kind)
        axis.plot(azimuth[these], zenith[these], "o", color=color, label=label)
    axis.plot(
        pg.optics.azimuth(guide, ray), pg.optics.zenith(guide, ray).rad2deg(), "*", color=COLORS[3],
        markersize=11, label="guide",
    )  # fmt: skip
    axis.plot(azimuth[chosen], zenith[chosen], "o", mfc="none", mec="#222222", markersize=12, label="chosen")
    axis.set(ylim=(0, 90), yticks=(30, 60, 90), yticklabels=("30°", "60°", ""))
    axis.set_title("candidates of one pixel", fontsize=9)


def draw_ambiguity(view: View) -> None:
    """Draw the six candidates of a pixel; the ambiguous azimuth, the choice of a guide, and the true azimuth."""
    rays, truth = view.camera.rays(), view.ground_truth
    assert truth is not None
    assert truth.normal is not None
    assert truth.mask is not None
    stokes = pg.optics.luminance(view.stokes())
    normals = view.camera.to_camera(truth.normal)
    cosine, sine = torch.cos(torch.tensor(TILT)), torch.sin(torch.tensor(TILT))
    x, y, z = normals.unbind(-1)
    guide = torch.stack((cosine * x + sine * z, y, cosine * z - sine * x), dim=-1)
    chosen = pg.optics.disambiguate(
        pg.optics.physical_candidates(stokes, rays, INDEX), guide, rays, azimuth_weight=1.0
    ).normal
    shown = truth.mask & (pg.optics.dolp(stokes) > FAINT)

    def hue(azimuth: Tensor) -> Tensor:
        """Return hues of a full turn."""
        return aolp_to_rgb(azimuth / 2, shown.to(azimuth))

    angle = pg.optics.aolp(stokes)
    maps = {
        "AoLP, if diffuse": angle,
        "AoLP + 90°, if specular": angle + torch.pi / 2,
        "guide": pg.optics.azimuth(guide, rays),
        "resolved": pg.optics.azimuth(chosen, rays),
        "true azimuth": pg.optics.azimuth(normals, rays),
    }
    figure = pyplot.figure(figsize=(9.6, 3.7), layout="constrained")
    grid = figure.add_gridspec(2, 4, width_ratios=(1.35, 1, 1, 1))
    row, column = PIXEL
    draw_candidates(
        figure.add_subplot(grid[:, 0], projection="polar"),
        stokes[:, row, column],
        guide[row, column],
        rays[row, column],
    )
    figure.legend(loc="outside lower left", frameon=False, ncols=4, fontsize=8)
    places = (grid[0, 1], grid[0, 2], grid[1, 1], grid[1, 2], grid[1, 3])
    for place, (name, azimuth) in zip(places, maps.items(), strict=True):
        axis = figure.add_subplot(place)
        axis.imshow(hue(azimuth), interpolation="nearest")
        if name == "true azimuth":
            axis.plot(column, row, "+", color="white", markersize=9)
        axis.set_title(name, fontsize=9)
        axis.axis("off")
    wheel = figure.add_subplot(grid[0, 3], projection="polar")
    turn = torch.linspace(-torch.pi, torch.pi, 181, dtype=torch.float64)
    colors = aolp_to_rgb(turn[None] / 2)[0] / 255
    wheel.bar(turn, 1, width=0.04, bottom=0.6, color=colors)
    wheel.set(yticks=(), xticks=(0, torch.pi / 2, torch.pi, 3 * torch.pi / 2), title="azimuth")
    wheel.title.set_fontsize(9)
    save(figure, "ambiguity")


PIXEL = (30, 50)
"""Row and column of the pixel of the candidates, on the black ball."""


def draw_separation(view: View) -> None:
    """Draw the exact solution for one view with the true normals, next to the true layers."""
    truth, rays = view.ground_truth, view.camera.rays()
    assert truth is not None
    assert truth.normal is not None
    assert truth.mask is not None
    found = pg.optics.exact_separation(view.stokes(), view.camera.to_camera(truth.normal), rays, INDEX)
    known = (truth.mask & found.conditioned)[..., None]
    figure, axes = pyplot.subplots(1, 5, figsize=(9.6, 1.62), layout="constrained")
    pictures = {
        "photograph": view.photograph(),
        "specular, solved": found.specular * known,
        "specular, true": truth.specular * known,
        "diffuse, solved": found.diffuse * known,
        "diffuse, true": truth.diffuse * known,
    }
    for axis, (name, picture) in zip(axes, pictures.items(), strict=True):
        axis.imshow(radiance_to_rgb(picture), interpolation="nearest")
        axis.set_title(name, fontsize=9)
        axis.axis("off")
    save(figure, "separation")


def main() -> None:
    mpl.use("agg")
    mpl.rcParams.update(STYLE)
    view = pg.load_scene(pg.demo_scene()).view(VIEW)
    draw_dolp()
    draw_ambiguity(view)
    draw_separation(view)


if __name__ == "__main__":
    main()
