"""Content of ``model.json`` in an exported package: units, axes, origin, cameras, scores, and unknown quantities."""

from __future__ import annotations

from typing import Any

from polarguide.results.evaluation.record import METRICS_FILE, read_metrics
from polarguide.results.evaluation.table import shown_metrics
from polarguide.results.export.placement import GENERATOR, Origin, Placement, transforms
from polarguide.runs.opened import OpenedRun

RECORD = "model.json"
"""File name of the record."""
FILES = {
    "model.glb": "textured mesh, lit by the viewer",
    "model-unlit.glb": "textured mesh with the picture's colors, for viewers without light",
    "splats.ply": "splats, -y up (SuperSplat, Spark, Unity, Unreal)",
    "splats.spz": "the same, compressed, +y up",
    "splats.sog": "the same, compressed, -y up",
    "splats-srgb.glb": "splats for readers that blend encoded colors (Babylon, PlayCanvas)",
    "splats-linear.glb": "splats for readers that blend linear colors (three.js)",
    "environment.exr": "the learned light as a panorama of linear radiance",
    "environment.hdr": "the same in the Radiance format",
    "environment.png": "the same as a picture",
    "preview.png": "a view of the run as a picture",
}
"""Description of each file of a package."""


def about_files(names: list[str]) -> dict[str, str]:
    """Return the descriptions of files by name."""
    return {name: FILES[name] for name in names}


def package_record(run: OpenedRun, placement: Placement, origin: Origin, base_color: str) -> dict[str, Any]:
    """Return the record of a package without its files.

    Args:
        run: the run; its scene is read. placement: placement of the files (+y up). origin: author and
            provenance.
        base_color: description of the base color.
    """
    unknown = [
        "the absolute brightness of base color and light: the learned light has no absolute scale",
        "surfaces that no camera saw: they are closed or continued from the nearest ones",
        *([] if placement.metric else ["the length of a unit"]),
    ]
    color = origin.presentation.color  # applies to linear RGB of the photographs
    cameras = {name: placement.camera(camera) for name, camera in run.cameras.items()}
    scored = (run.folder / METRICS_FILE).exists()
    return {
        "generator": GENERATOR,
        **origin.record(),
        "units": "meters" if placement.metric else "units of the scene",
        "up_axis": "+y",
        "rotation_of_scene": placement.rotation.flatten().tolist(),
        "scale_of_scene": placement.scale,
        "color": None if color is None else color.tolist(),
        "base_color": base_color,
        "not_known": unknown,
        "scores": dict(shown_metrics(read_metrics(run.folder), scores_only=True)) if scored else {},
        "cameras": [
            {"view": name, **{key: value for key, value in frame.items() if key != "file_path"}}
            for name, frame in zip(cameras, transforms(cameras)["frames"], strict=True)
        ],
    }
