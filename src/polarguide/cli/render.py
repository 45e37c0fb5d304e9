"""``polarguide render``."""

from __future__ import annotations

from pathlib import Path

from polarguide.cli.console import RunFolder, opened, say
from polarguide.core.errors import PolarguideError, require_package
from polarguide.core.options import ComputeOptions, PictureFormat, check_finite

FRAMES = 120


def render(
    run: RunFolder,
    /,
    *,
    views: str = "test",
    layers: str = "final,base,reflection,specular,diffuse,strength,roughness,metalness,normal,depth,dolp,aolp",
    path: str = "",
    frames: int = FRAMES,
    video: Path | None = None,
    format: PictureFormat = "png",
    transparent: bool = False,
    environment: Path | None = None,
    rotate_environment: float = 0.0,
    out: Path | None = None,
    compute: ComputeOptions = ComputeOptions(),
) -> None:
    """Render a run's layers to PNG, with a contact sheet beside the ground truth; or along a path, as a video.

    specular and diffuse are the contributions that add up to final; normals are in camera space, blue facing the
    camera.

    Args:
        run: Run folder.
        views: test, train, all, or names separated by commas.
        layers: Any of final, base, reflection, specular, diffuse, strength, roughness, metalness, normal, depth,
            alpha, and the predicted polarization: stokes, dolp, aolp.
        path: In place of views: orbit, spiral, interpolate (through the photographs), or a JSON file of cameras.
        frames: Pictures along the path (a file has its own).
        video: MP4 file to write of the path, layers side by side; PNG files if not given.
        format: Of the layers of views: png as a display shows them, or exr and npy with the linear numbers, whose units
            layers.json states. The contact sheet is PNG.
        transparent: PNG files of views are transparent where nothing is, without a dark rim around the subject.
        environment: Panorama of linear radiance (.hdr, .exr) to be reflected in place of the learned environment.
        rotate_environment: Degrees by which to turn the environment, counter-clockwise seen from above.
        out: Folder to write; RUN/render by default.
    """
    if video is not None and (not path or video.suffix.lower() != ".mp4"):
        raise PolarguideError(
            "video",
            expected="a name that ends in .mp4, and a --path",
            found=f"{video} and {path or 'no path'}",
            remedy="Write for example --path orbit --video film.mp4.",
        )
    if not path and frames != FRAMES:
        raise PolarguideError(
            "frames",
            expected="a --path",
            found="none",
            remedy="Give for example --path orbit, or leave it out.",
        )
    check_finite("rotate_environment", rotate_environment, -3600.0, 3600.0)
    if video is not None:
        require_package("imageio_ffmpeg", "--video")
    if environment is not None and environment.suffix.lower() == ".exr":
        require_package("OpenEXR", str(environment))
    if format == "exr":
        require_package("OpenEXR", "--format exr")
    if path and format != "png":
        raise PolarguideError(
            "format", expected="png along a --path", found=format, remedy="Name views in place of a path."
        )
    if transparent and (path or format != "png"):
        raise PolarguideError(
            "transparent",
            expected="PNG files of views",
            found=f"--path {path}" if path else f"--format {format}",
            remedy="Leave one of the two out.",
        )
    names = [name.strip() for name in layers.split(",") if name.strip()]
    trained, reporter = opened(run, compute)
    trained.relight(environment, rotate_environment, reporter=reporter)
    if path:
        trained.write_film(
            video or out or run / "render", path=path, layers=names, frames=frames, reporter=reporter
        )
        return
    sheet = trained.write_pictures(
        out, views=views, layers=names, format=format, transparent=transparent, reporter=reporter
    )
    say(f"pictures: {sheet.parent}   contact sheet: {sheet}")
