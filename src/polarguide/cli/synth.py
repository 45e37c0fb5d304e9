"""``polarguide synth``."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Annotated, Literal

import tyro

from polarguide.cli.console import console
from polarguide.cli.progress import ConsoleReporter
from polarguide.cli.threads import use_threads
from polarguide.errors import PolarguideError
from polarguide.options import ThreadOptions


def synth(
    scene: Annotated[str, tyro.conf.Positional],
    /,
    *,
    out: Path,
    views: int | None = None,
    size: str = "256x192",
    samples: int = 64,
    seed: int = 0,
    sensor: Literal["ideal", "imx250myr", "imx250mzr"] = "ideal",
    noise: float = 0.0,
    roughness: float | None = None,
    index: float | None = None,
    spacing: float | None = None,
    sweep: str | None = None,
    color: Literal["rgb", "spectral"] = "rgb",
    ground_truth: Literal["test", "all"] = "test",
    machine: ThreadOptions = ThreadOptions(),
) -> None:
    """Render a polarized scene with ground truth: figure, kit, car, cup, water, proof, or a scene file.

    Needs the extra polarguide[synth]. A rendering that was stopped goes on with the same command. docs/dataset.md
    describes scene files and what is written.

    Args:
        scene: Name of a preset, or path of a scene file in JSON.
        out: Scene folder to write.
        views: Number of views; without it what the scene says.
        size: Width and height of the pictures.
        samples: Paths per pixel; test views take four times as many.
        seed: Seed of every random draw.
        sensor: A sensor whose 12-bit raw mosaics are written, too, for polarguide prepare.
        noise: Photon and read noise: 1 is a sensor exposed to full scale, 2 a quarter of that light, 0 none.
        roughness: Roughness of all plastic objects in the foreground.
        index: Refractive index of these.
        spacing: Degrees between neighboring views on a ring.
        sweep: A family of scenes, such as views=9,18,36,63 or noise=0,1,2,4; also roughness, index and spacing.
        color: Three channels with exact values, or a sampled spectrum.
        ground_truth: Views that get ground truth.
    """
    threads = machine.threads
    use_threads(threads)
    reporter = ConsoleReporter()
    asked = import_module("polarguide.synth.settings")
    width, height = _size(size)
    overrides = asked.Overrides(views=views, spacing=spacing, roughness=roughness, index=index)
    settings = asked.SynthSettings(
        width=width,
        height=height,
        samples=samples,
        seed=seed,
        sensor=sensor,
        noise=noise,
        color=color,
        ground_truth=ground_truth,
    )
    spec = asked.find_scene(scene)
    if sweep is not None:
        sweeps = import_module("polarguide.synth.sweep")
        family = sweeps.parse_sweep(sweep)
        folders = sweeps.sweep_scenes(spec, out, settings, overrides, family, reporter, threads=threads)
        console.print(f"scenes: {' '.join(str(folder) for folder in folders)}", markup=False)
        return
    render = import_module("polarguide.synth.render")
    done = render.synthesize(overrides.apply(spec), out, settings, reporter, threads=threads)
    manifest = import_module("polarguide.synth.manifest")
    console.print(
        f"scene: {done}   SHA-256 of its {manifest.MANIFEST}: {manifest.scene_digest(done)}", markup=False
    )
    if sensor == "ideal":
        console.print(f"next: polarguide train {done} --out runs/{done.name}", markup=False)
    else:
        console.print(
            f"next: polarguide prepare {done / 'raw'} --out {done}-prepared --sensor {sensor.upper()} --bits 12 "
            f"--black-level 64 --calibration {done / 'calibration.json'} --poses {done}",
            markup=False,
        )


def _size(text: str) -> tuple[int, int]:
    try:
        width, height = (int(part) for part in text.lower().split("x"))
    except ValueError:
        raise PolarguideError(
            "--size",
            expected="width and height such as 256x192",
            found=repr(text),
            remedy="Give whole numbers.",
        ) from None
    return width, height
