"""``polarguide priors``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import tyro
from numpy.typing import NDArray
from torch import Tensor

from polarguide import optics
from polarguide.capture import View
from polarguide.cli.common import OpenRun, Transfer, console, open_run, read_scene, select_views, use_threads
from polarguide.errors import PolarguideError
from polarguide.training.priors import facing_chromatic, guide_normals
from polarguide.visualization import figures

Picture = NDArray[np.uint8]
SHEET_VIEWS = 8


def priors(
    scene: Annotated[Path, tyro.conf.Positional],
    /,
    *,
    out: Path,
    run: Path | None = None,
    views: str = "test",
    refractive_index: float = 1.5,
    threshold: float = 0.05,
    downscale: int = 1,
    transfer: Transfer = "linear",
    threads: int = 0,
) -> None:
    """Pictures of what polarization says about a scene, before or after training.

    S0, DoLP, AoLP, zenith, both separations, polarization normals, those that color differences tell (gray where they
    decide nothing), and the mask of usable pixels. The exact separation
    needs normals: those of a trained run with --run, else the polarization normals themselves, with their ambiguity
    resolved only by the surface facing the camera (a rough guess, and named so in the file).

    Args:
        scene: Scene folder.
        out: Folder to write.
        run: A run trained on this scene (at the same --downscale), whose normals resolve the ambiguity.
        views: test, train, all, or names separated by commas.
        refractive_index: Of the surfaces.
        threshold: DoLP above which a pixel's normal is used.
        downscale: Average the pictures over boxes of this many pixels first.
        transfer: How the files encode radiance.
        threads: Threads to use; 0 takes all cores.
    """
    use_threads(threads)
    opened = None
    if run is not None:
        opened = open_run(run)
        if opened.configuration.downscale != downscale:
            raise PolarguideError(
                "--downscale",
                expected=f"{opened.configuration.downscale}, as {run} was trained",
                found=str(downscale),
                remedy="Give the same factor.",
            )
    chosen = select_views(read_scene(scene, downscale=downscale, transfer=transfer), views)
    out.mkdir(parents=True, exist_ok=True)
    rows: list[list[Picture]] = []
    labels: list[str] = []
    names: list[str] = []
    for view in chosen:
        pictures = prior_pictures(view, opened, refractive_index, threshold)
        names = list(pictures)
        for name, picture in pictures.items():
            figures.write_png(out / f"{view.name}_{name}.png", picture)
        if len(rows) < SHEET_VIEWS:
            rows.append(list(pictures.values()))
            labels.append(view.name)
    sheet = out / "contact_sheet.png"
    figures.write_png(sheet, figures.contact_sheet(rows, labels, names))
    console.print(f"pictures: {out}   contact sheet: {sheet}")


@torch.no_grad()
def prior_pictures(view: View, opened: OpenRun | None, index: float, threshold: float) -> dict[str, Picture]:
    """All prior pictures of one view, by the name their file gets."""
    rays = view.camera.rays()
    stokes = optics.stokes(view.intensities())
    luminance = optics.luminance(stokes)
    dolp, aolp = optics.dolp(luminance), optics.aolp(luminance)
    zenith = optics.diffuse_zenith(dolp, index)
    guide, source = _guide(view, opened, rays, luminance, index)
    mask = optics.polarization_mask(
        luminance, threshold=threshold, invalid=view.invalid, saturated=view.saturated
    )
    candidates = optics.physical_candidates(luminance, rays, index)
    normal = optics.disambiguate(candidates, guide, rays, azimuth_weight=0.5).normal
    good = ~(view.invalid | view.saturated)
    chromatic, certain = facing_chromatic(stokes, guide, rays, index, good)
    paper = optics.paper_separation(stokes, zenith, index)
    exact = optics.exact_separation(stokes, guide, rays, index)
    degrees = torch.rad2deg(zenith)
    return {
        "S0": figures.radiance_to_rgb(view.photograph()),
        "DoLP": figures.dolp_to_rgb(dolp),
        "AoLP": figures.aolp_to_rgb(aolp, dolp),
        "zenith_diffuse": figures.scalar_to_rgb(degrees, 0.0, 90.0),
        "specular_paper": figures.radiance_to_rgb(paper.specular / 2),
        "diffuse_paper": figures.radiance_to_rgb(paper.diffuse / 2),
        f"specular_exact_{source}": figures.radiance_to_rgb(exact.specular / 2),
        f"diffuse_exact_{source}": figures.radiance_to_rgb(exact.diffuse / 2),
        f"normal_{source}": figures.normal_to_rgb(
            view.camera.to_world(normal * mask[..., None]), view.camera
        ),
        "normal_by_color": figures.normal_to_rgb(
            view.camera.to_world(chromatic * (certain[..., None] > 0)), view.camera
        ),
        "mask": figures.scalar_to_rgb(mask.float(), 0.0, 1.0),
    }


def _guide(
    view: View, opened: OpenRun | None, rays: Tensor, luminance: Tensor, index: float
) -> tuple[Tensor, str]:
    """Normals in camera axes that resolve the ambiguity, and where they come from."""
    if opened is not None:
        normal = opened.render(opened.scene.view(view.name)).normal
        assert normal is not None
        return guide_normals(view.camera.to_camera(normal), rays)[0], "by_run"
    upward = torch.tensor([0.0, -0.5, -1.0]).expand_as(rays)
    guess = torch.nn.functional.normalize(upward, dim=-1)
    chosen = optics.disambiguate(
        optics.physical_candidates(luminance, rays, index), guess, rays, azimuth_weight=0.0
    ).normal
    return chosen, "by_polarization"
