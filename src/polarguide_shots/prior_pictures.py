"""Pictures of the polarization and the priors of a scene's views, and a contact sheet of them."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from polarguide import optics
from polarguide.capture import Scene, View
from polarguide.core.errors import PolarguideError
from polarguide.core.files import make_folder
from polarguide.core.options import PathLike, check_finite, index_of
from polarguide.core.progress import SILENT, Reporter
from polarguide.results.rendering.pictures import CONTACT_SHEET, SHEET_VIEWS, views_named
from polarguide.runs.opened import OpenedRun
from polarguide.training.priors import facing_chromatic, guide_normals
from polarguide.training.recipe import Priors
from polarguide.visualization import figures
from polarguide.visualization.figures import Picture, contact_sheet


def write_priors(
    scene: Scene,
    out: PathLike,
    *,
    run: OpenedRun | None = None,
    views: str = "test",
    refractive_index: float | None = None,
    threshold: float = 0.05,
    reporter: Reporter = SILENT,
) -> Path:
    """Write PNG files that show the polarization of a scene, and a contact sheet of all of them.

    The pictures show S0, DoLP, AoLP, zenith, both separations, polarization normals, normals from color
    differences, and the mask of usable pixels. The exact separation needs normals. They come from a trained run or,
    without a run, from polarization. In the second case, only the visibility of the surface resolves the ambiguity of
    the normals.

    Args:
        scene: a scene with poses.
        out: folder to write.
        run: a run trained on this scene at this size, whose normals resolve the ambiguity.
        views: ``test``, ``train``, ``all``, or names separated by commas.
        refractive_index: refractive index of the surfaces; None takes the index of the scene.
        threshold: DoLP above which a pixel's normal is used.
        reporter: receives the progress.

    Returns:
        The path of the contact sheet.

    Raises:
        PolarguideError: a view does not exist, the pictures of a view do not determine its polarization, or the run was
            trained at another picture size.
    """
    check_finite("threshold", threshold, 0.0, 1.0)
    index = index_of(refractive_index, scene.refractive_index)
    check_finite("refractive_index", index, 1.0001, 4.0)
    if run is not None and run.configuration.downscale != scene.downscale:
        raise PolarguideError(
            "downscale",
            expected=f"{run.configuration.downscale}, the factor of {run.folder}",
            found=str(scene.downscale),
            remedy="Use the same factor.",
        )
    chosen = views_named(scene, views)
    for view in chosen:
        if not view.is_determined:
            raise view.undetermined("polarization at every pixel")
    make_folder(out := Path(out))
    rows: list[dict[str, Picture]] = []
    with reporter.track("drawing", len(chosen)) as advance:
        for number, view in enumerate(chosen):
            pictures = prior_pictures(view, run, index, threshold)
            for name, picture in pictures.items():
                figures.write_png(out / f"{view.name}_{name}.png", picture)
            rows = [*rows, pictures][:SHEET_VIEWS]
            advance(number + 1)
    sheet = out / CONTACT_SHEET
    labels = [view.name for view in chosen[:SHEET_VIEWS]]
    figures.write_png(sheet, contact_sheet([[*row.values()] for row in rows], labels, [*rows[0]]))
    return sheet


@torch.no_grad()
def prior_pictures(view: View, run: OpenedRun | None, index: float, threshold: float) -> dict[str, Picture]:
    """Return all polarization pictures of one view by file name."""
    rays = view.camera.rays()
    stokes = view.stokes()
    luminance = optics.luminance(stokes)
    dolp = optics.dolp(luminance)
    aolp = optics.aolp(luminance)
    zenith = optics.diffuse_zenith(dolp, index)
    guide, source = resolving_normals(view, run, rays, luminance, index)
    mask = optics.polarization_mask(
        luminance, threshold=threshold, invalid=view.invalid, saturated=view.saturated
    )
    candidates = optics.physical_candidates(luminance, rays, index)
    normal = optics.disambiguate(candidates, guide, rays, azimuth_weight=0.5).normal
    good = ~(view.invalid | view.saturated)
    chromatic, certain = facing_chromatic(stokes, guide, rays, index, good, Priors())
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


def resolving_normals(
    view: View, run: OpenedRun | None, rays: Tensor, luminance: Tensor, index: float
) -> tuple[Tensor, str]:
    """Return camera-space normals that resolve the ambiguity of polarization normals, and the name of their source."""
    if run is not None:
        normal = run.result(view.name, depth=False).to("cpu").normal
        return guide_normals(view.camera.to_camera(normal), rays, Priors.minimum_normal)[0], "by_run"
    guess = torch.nn.functional.normalize(torch.tensor([0.0, -0.5, -1.0]).expand_as(rays), dim=-1)
    candidates = optics.physical_candidates(luminance, rays, index)
    return optics.disambiguate(candidates, guess, rays, azimuth_weight=0.0).normal, "by_polarization"
