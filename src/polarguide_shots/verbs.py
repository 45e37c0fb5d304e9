"""Commands ``measure``, ``priors``, ``calibrate`` and ``scale``."""

from __future__ import annotations

import importlib
import os
import shlex
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import tyro

import polarguide
from polarguide.cli.console import ConsoleReporter, console, print_error, say, set_threads
from polarguide.core.errors import PolarguideError, require
from polarguide.core.files import make_folder, read_file, write_whole
from polarguide.core.options import Memory, SceneOptions, ThreadOptions, check_finite
from polarguide.core.records import option_name
from polarguide.core.system import StopSignals
from polarguide.preparation.settings import CalibrationOptions
from polarguide_shots.calibration.settings import CalibrateSettings
from polarguide_shots.options import MeasureOptions, ShotOptions, WatchOptions
from polarguide_shots.ring_scale import ring_scale


def measure(
    paths: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="PATH ...")] = (),
    /,
    *,
    out: Path,
    options: Annotated[MeasureOptions, tyro.conf.arg(name="")],
    watching: Annotated[WatchOptions, tyro.conf.arg(name="")],
    reading: Annotated[ShotOptions, tyro.conf.arg(name="")],
    angles: Annotated[CalibrationOptions, tyro.conf.arg(name="")],
    compute: Annotated[ThreadOptions, tyro.conf.arg(name="")],
) -> int:
    """Measure many shots for inspection lines: S0, DoLP and AoLP by region, limits, a golden part.

    Writes table.csv (a line per region), table.jsonl (a line per shot), and pictures of shots beyond their limits.
    Repeat the command to resume: shots in the table are not measured again. The exit status is 3 if a shot is beyond a
    limit, else 2 if a shot could not be read. docs/how-to/inspection-line.md has a complete example.

    Args:
        paths: Raw mosaics, shots of four files, scenes, or folders of them.
        out: Folder of the table.
    """
    set_threads(compute.threads)
    require(
        bool(paths) == (watching.watch is None),
        "--watch",
        expected="shots to measure, or a folder to watch",
        found="both" if paths else "neither",
        remedy="Give files and folders for one pass, or --watch FOLDER.",
    )
    for name in ("settle", "patience", "idle"):
        require(
            watching.watch is not None or getattr(watching, name) == getattr(WatchOptions, name),
            f"--{name}",
            expected="--watch",
            found="no --watch",
            remedy="Remove the option, or watch a folder.",
        )
    reading = replace(reading, calibration=angles.read(), analyzers=angles.analyzers())
    heard = partial(_print_entry, every=watching.watch is not None)
    line = importlib.import_module("polarguide_shots.measurement.line")
    if watching.watch is None:
        outcome = line.measure_shots(paths, out, options, reading, heard=heard, reporter=ConsoleReporter())
    else:
        with StopSignals() as should_stop:
            outcome = line.watch_folder(
                watching.watch, out, options, reading, watching,
                should_stop=should_stop, heard=heard, reporter=ConsoleReporter(),
            )  # fmt: skip
    _print_outcome(outcome)
    if outcome.trouble:
        print_error(outcome.trouble)
    if outcome.waiting:
        names = ", ".join(outcome.waiting[:4]) + (", ..." if len(outcome.waiting) > 4 else "")
        error = PolarguideError(
            watching.watch,
            expected="complete shots",
            found=f"{len(outcome.waiting)} incomplete shots, which were not measured ({names})",
            remedy="Complete, rename or remove their files, and repeat the command.",
        )
        print_error(str(error))
    return int(outcome.exit_status)


def _print_entry(entry: Any, *, every: bool) -> None:
    """Print a shot that exceeds a limit or could not be read. If ``every`` is True, print all shots."""
    if entry.status == "unread":
        print_error(entry.why)
    elif entry.status == "beyond":
        console.print("[bold red]beyond:[/] ", end="")
        faults = (f"{row['region']} {row['why']}" for row in entry.regions if row["why"])
        say(f"{entry.shot}: {'; '.join(faults)}")
    elif every:
        say(f"{entry.status}: {entry.shot}")


def _print_outcome(outcome: Any) -> None:
    counts = outcome.counts
    shots = ", ".join(
        f"{counts[status]} {status}"
        for status in ("measured", "within", "beyond", "unread")
        if counts[status]
    )
    before = f" ({outcome.earlier} of them earlier)" if outcome.earlier else ""
    say(f"shots: {shots or 'none'}{before}")
    pictures = f"   pictures: {outcome.folder}/beyond" if counts["beyond"] else ""
    say(f"table: {outcome.folder}/table.csv, .jsonl{pictures}")


def run_priors(
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
    memory: Memory | None = None,
    shots: Annotated[ShotOptions, tyro.conf.arg(name="")],
    angles: Annotated[CalibrationOptions, tyro.conf.arg(name="")],
    machine: Annotated[ThreadOptions, tyro.conf.arg(name="")],
) -> None:
    """Write polarization maps of a shot, many shots or a scene: pictures, numbers and a page.

    The maps are S0, DoLP and AoLP with their standard deviations, both separations, polarization normals with the
    zeniths of their candidates, and the reasons against pixels. A shot is a raw mosaic (with --sensor), four files of a
    rotating filter (names or folders with 0, 45, 90, 135), or a view of a scene without poses. A folder may contain
    many shots. The exact separation needs normals. With --run these are the normals of a trained run. Otherwise they
    are polarization normals, whose ambiguity is resolved by the candidate that faces the camera (a rough guess).
    docs/how-to/one-shot.md has more information.

    Args:
        paths: Mosaics, shots, folders of them, or a scene folder.
        out: Folder to write: a folder for each shot, or pictures and a contact sheet for a scene with poses.
        formats: Formats of the maps: some of png,exr,npy,page. Default: all for shots, none for a scene with poses.
        intrinsics: fx,fy,cx,cy of the developed pictures, for normals; default: parallel rays.
        refractive_index: Refractive index of the surfaces; default: the value in scene.json, else 1.5.
        run: For a scene: a run trained on it (at the same --downscale), whose normals resolve the ambiguity.
        views: For a scene: test, train, all, or names separated by commas.
        threshold: For a scene: DoLP above which a pixel's normal is used; default: 0.05.
        downscale: For a scene: average the pictures over boxes of this many pixels first.
        memory: For a scene: memory of the pictures in GiB; default: 80 % of the free memory.
    """
    set_threads(machine.threads)
    reporter = ConsoleReporter()
    require(
        paths, "PATH", expected="at least one shot or scene", found="none", remedy="Name files or folders."
    )
    options = replace(shots, calibration=angles.read(), analyzers=angles.analyzers())
    names = None if formats is None else [name.strip() for name in formats.split(",") if name.strip()]
    if len(paths) == 1 and os.path.lexists(paths[0] / "sparse"):
        _refuse("shots", "a scene with poses", intrinsics=intrinsics)
        sheet = polarguide.priors(
            paths[0],
            out,
            run=None if run is None else polarguide.open_run(run, reporter=reporter),
            views=views,
            threshold=0.05 if threshold is None else threshold,
            reading=SceneOptions(downscale, "srgb" if shots.transfer == "srgb" else "linear", memory),
            formats=names or (),
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
    found = str(downscale)
    require(
        downscale == 1, "downscale", expected="1 for shots", found=found, remedy="Use --demosaic quarter."
    )
    outcome = polarguide.shot_priors(
        paths,
        out,
        shots=options,
        formats=names,
        intrinsics=intrinsics,
        refractive_index=refractive_index,
        reporter=reporter,
    )
    for name, folder in list(outcome.folders.items())[:4]:
        page = folder / "shot.html"
        say(f"{name}: {page if page.exists() else folder}")
    if len(outcome.folders) > 4:
        say(f"... and {len(outcome.folders) - 4} more in {out}")
    require(
        not outcome.faults,
        out,
        expected=f"{len(outcome.faults) + len(outcome.folders)} shots",
        found=f"{len(outcome.faults)} failed shots ({', '.join(list(outcome.faults)[:4])})",
        remedy="See the warnings above; the other shots are written.",
    )


def _refuse(expected: str, found: str, **options: object) -> None:
    """Check that options are not used which apply only to ``expected``.

    Raises:
        PolarguideError: the user specified one of the options.
    """
    for name, value in options.items():
        remedy = f"Remove the option, or specify {expected}."
        require(value is None, option_name(name), expected=expected, found=found, remedy=remedy)


def calibrate(
    shots: Annotated[Path, tyro.conf.Positional],
    /,
    *,
    out: Path,
    settings: Annotated[CalibrateSettings, tyro.conf.arg(name="")],
    compute: Annotated[ThreadOptions, tyro.conf.arg(name="")],
) -> None:
    """Calibrate the polarizers of a polarization camera, from shots of a polarizer in front of the lens.

    The file corrects extinction ratio, angle and throughput of every position. It is the option --calibration of
    prepare, priors, measure and inspect. docs/how-to/calibrate.md describes the shots.

    Args:
        shots: Folder of raw mosaics of a linear polarizer in front of a uniform light, at five or more angles.
        out: File to write, ending in .safetensors; a picture (PNG) of the same name is written next to it.
    """
    set_threads(compute.threads)
    calibration = importlib.import_module("polarguide_shots.calibration.calibrate")
    outcome = calibration.calibrate_sensor(shots, out, settings, ConsoleReporter())
    say(f"calibration: {outcome.path}   picture: {outcome.picture}")
    option = f"--sensor {settings.sensor} --calibration {shlex.quote(str(outcome.path))}"
    say(f"next: polarguide prepare RAW --out SCENE {option}")


def scale(*, diameter: float, out: Path = Path("filter-scale.svg")) -> None:
    """Print a scale of angles for the ring of a polarizing filter: an SVG file in exact millimeters.

    Fix the paper ring to the lens around the rotating ring of the filter, and read it from the front. Seen from the
    front, angles count clockwise. From behind the camera they count counter-clockwise, as prepare reads them.
    docs/how-to/capture.md describes its use.

    Args:
        diameter: Outer diameter of the rotating ring of the filter in mm. A 67 mm filter has about 70; measure it.
        out: SVG file to write.
    """
    check_finite("diameter", diameter, 20.0, 160.0)
    data = ring_scale(diameter).encode()
    same = not out.exists() or (out.is_file() and read_file(out) == data)
    require(
        same, out, expected="a new file", found="a file with other contents", remedy="Give another --out."
    )
    make_folder(out.parent)
    write_whole(out, data)
    console.print(f"scale: {out} (print at 100 %, and measure the 50 mm line)", markup=False)
