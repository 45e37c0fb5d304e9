"""``polarguide export``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import tyro

from polarguide.cli.console import RunFolder, opened, say, size_text
from polarguide.core.errors import require_package
from polarguide.core.options import (
    EXPORT_EXTRAS,
    EXPORT_PACKAGES,
    ExportFormat,
    ModelOptions,
    ThreadOptions,
)


def export(
    run: RunFolder,
    /,
    *,
    format: ExportFormat,
    out: Path | None = None,
    resolution: int = 192,
    spz_version: Literal[3, 4] = 3,
    model: Annotated[ModelOptions, tyro.conf.arg(name="")] = ModelOptions(),
    machine: ThreadOptions = ThreadOptions(),
) -> None:
    """Write a run as the files of other programs.

    ply, spz, sog, splat-glb and splat-usdz are ordinary splats, with reflections baked as far as harmonics carry them;
    mesh (GLB and PLY) is fused from rendered depth, with diffuse colors and learned normals; glb (or obj, usdz) is a
    textured model for Blender, game engines and viewers, whose base color has neither highlights nor shading; stl is
    its closed surface for 3D printing; points are opaque Gaussians with normals; environment is the learned light as a
    panorama (EXR, HDR and PNG); cameras are a COLMAP model and transforms.json; all is a package of most of these.

    Args:
        run: Run folder.
        format: ply, spz, sog, splat-glb, splat-usdz, mesh, glb, obj, usdz, stl, points, environment, cameras or all.
        out: Folder to write; RUN/export by default.
        resolution: Voxels of the mesh along its longest side.
        spz_version: Version of the SPZ file; readers are split between the two.
    """
    for package in EXPORT_PACKAGES.get(format, ()):
        require_package(package, f"--format {format}", extra=EXPORT_EXTRAS.get(package, ""))
    trained, reporter = opened(run, machine)
    for path in trained.export(
        format, out, resolution=resolution, spz_version=spz_version, model=model, reporter=reporter
    ):
        size = f" ({size_text(path.stat().st_size)})" if path.is_file() else ""
        say(f"{format}: {path}{size}")
