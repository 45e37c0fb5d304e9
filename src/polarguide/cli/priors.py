"""``polarguide priors``."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import tyro

import polarguide
from polarguide.cli.console import ConsoleReporter, say, use_threads
from polarguide.core.errors import PolarguideError
from polarguide.core.options import SceneOptions, ThreadOptions
from polarguide.core.records import option_name
from polarguide.preparation.settings import CalibrationOptions
from polarguide.shots.options import ShotOptions


def priors(
    paths: Annotated[tuple[Path, ...], tyro.conf.Positional],
    /,
    *,
    out: Path,
    formats: str | None = None,
    intrinsics: str | None = None,
    refractive_index: float | None = None,
    run: Path | None = None,
    views: str = "test",
    threshold: float | None = None,
    downscale: int = 1,
    memory: float | None = None,
    shots: Annotated[ShotOptions, tyro.conf.arg(name="")],
    angles: Annotated[CalibrationOptions, tyro.conf.arg(name="")],
    machine: Annotated[ThreadOptions, tyro.conf.arg(name="")],
) -> None:
    """Polarization maps of a shot, many shots or a scene: pictures, numbers and a page.

    S0, DoLP and AoLP with their standard deviations, both separations, polarization normals with the zeniths of their
    candidates, and the pixels that say nothing. A shot is a raw mosaic (with --sensor), four files of a rotating filter
    (names or folders with 0, 45, 90, 135), or a view of a scene without poses; folders may hold many. The exact
    separation needs normals: those of a trained run with --run, else the polarization normals themselves, with their
    ambiguity resolved only by the surface facing the camera (a rough guess, and named so). docs/how-to/one-shot.md
    says more.

    Args:
        paths: Mosaics, shots, folders of them, or a scene folder.
        out: Folder to write: a folder for each shot in it; pictures and a contact sheet for a scene with poses.
        formats: Of the maps: some of png,exr,npy,page. Without it all for shots, none for a scene with poses.
        intrinsics: fx,fy,cx,cy of the developed pictures, for normals; without them the rays are taken to be parallel.
        refractive_index: Of the surfaces; without it as scene.json says, else 1.5.
        run: For a scene: a run trained on it (at the same --downscale), whose normals resolve the ambiguity.
        views: For a scene: test, train, all, or names separated by commas.
        threshold: For a scene: DoLP above which a pixel's normal is used; without it 0.05.
        downscale: For a scene: average the pictures over boxes of this many pixels first.
        memory: For a scene: GiB that the pictures may take; without it, 80 % of what is free.
    """
    use_threads(machine.threads)
    reporter = ConsoleReporter()
    if not paths:
        raise PolarguideError(
            "PATH", expected="at least one shot or scene", found="none", remedy="Name files or folders."
        )
    options = replace(shots, calibration=angles.read(), analyzers=angles.analyzers())
    some = None if formats is None else [name.strip() for name in formats.split(",") if name.strip()]
    if len(paths) == 1 and os.path.lexists(paths[0] / "sparse"):
        _refuse("shots", "a scene with poses", intrinsics=intrinsics)
        sheet = polarguide.priors(
            paths[0],
            out,
            run=None if run is None else polarguide.open_run(run, reporter=reporter),
            views=views,
            threshold=0.05 if threshold is None else threshold,
            reading=SceneOptions(downscale, "srgb" if shots.transfer == "srgb" else "linear", memory),
            formats=some or (),
            shots=replace(options, transfer="auto"),
            refractive_index=refractive_index,
            reporter=reporter,
        )
        say(f"pictures: {out}   contact sheet: {sheet}")
        return
    _refuse(
        "a scene with poses",
        "shots",
        run=run,
        views=None if views == "test" else views,
        threshold=threshold,
        memory=memory,
    )
    if downscale != 1:
        raise PolarguideError(
            "downscale", expected="1 for shots", found=str(downscale), remedy="Use --demosaic quarter."
        )
    outcome = polarguide.shot_priors(
        paths,
        out,
        shots=options,
        formats=some,
        intrinsics=intrinsics,
        refractive_index=refractive_index,
        reporter=reporter,
    )
    for name, folder in list(outcome.folders.items())[:4]:
        page = folder / "shot.html"
        say(f"{name}: {page if page.exists() else folder}")
    if len(outcome.folders) > 4:
        say(f"... and {len(outcome.folders) - 4} more in {out}")
    if outcome.faults:
        total = len(outcome.faults) + len(outcome.folders)
        raise PolarguideError(
            out,
            expected=f"{total} shots",
            found=f"{len(outcome.faults)} that failed ({', '.join(list(outcome.faults)[:4])})",
            remedy="The warnings above say why; the others are written.",
        )


def _refuse(expected: str, found: str, **options: object) -> None:
    """Refuse options that are given and mean something for others alone."""
    for name, value in options.items():
        if value is not None:
            raise PolarguideError(
                option_name(name), expected=expected, found=found, remedy=f"Leave it out, or name {expected}."
            )
