"""Verbs of runs: demo, train, eval, render, view, share, export; and the verb run.

``polarguide run`` goes from a folder of pictures to a scene in a browser by calling other verbs.
"""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from rich.table import Table
from rich.text import Text

import polarguide
from polarguide.capture.sensor.pattern import SensorName
from polarguide.cli import app
from polarguide.cli.console import ConsoleReporter, RunFolder, console, open_run_folder, say, size_text, warn
from polarguide.core.errors import PolarguideError, require, require_package
from polarguide.core.options import (
    EXPORT_PACKAGES,
    LOOPBACK,
    Axes,
    ComputeOptions,
    DeviceName,
    ExportFormat,
    ModelOptions,
    NormalOptions,
    PictureFormat,
    PlyFields,
    SceneOptions,
    SessionOptions,
    ThreadOptions,
    VisitorOptions,
    check_finite,
    picture_size,
)
from polarguide.core.records import option_name, read_record
from polarguide.core.system import StopSignals
from polarguide.core.text import canonical, command, printable
from polarguide.preparation.settings import PrepareSettings
from polarguide.training.settings import TrainSettings


def train_scene(
    scene: Annotated[Path, tyro.conf.Positional],
    /,
    *,
    out: Path,
    recipe: str = "polarguide-stokes",
    settings: TrainSettings = TrainSettings(),
    reading: SceneOptions = SceneOptions(),
    session: SessionOptions = SessionOptions(),
    resume: bool = False,
) -> None:
    """Train a recipe on a scene.

    Ctrl-C stops the training and saves its state; --resume continues to the same result.

    Args:
        scene: Scene folder: polar/<view>_000|_045|_090|_135.png or four folders I-00 I-45 I-90 I-135, and a COLMAP
            model in sparse/0.
        out: Run folder to write (configuration, checkpoint, log, PLY).
        recipe: Method: polarguide-stokes (renders the measured polarization as well), polarguide (PolarGuide-GSDR's
            stages with repaired physics), polarguide-paper; 3dgs, 3dgs-dr and ref-gs, which ignore
            polarization; an ablation of one, such as polarguide:without-normals; or a recipe of an installed
            package.
        resume: Continue the run in --out.
    """
    with StopSignals() as should_stop:
        try:
            polarguide.train(
                scene,
                out,
                recipe=recipe,
                settings=settings,
                session=session,
                reading=reading,
                resume=resume,
                reporter=ConsoleReporter(),
                should_stop=should_stop,
            )
        except KeyboardInterrupt as stopped:
            if str(stopped):  # a requested stop; the text names the last step
                say(f"{stopped}; the same train command and --resume continue")
            raise
    say(f"trained: {out}   next: {command('eval', out)}   {command('view', out)}")


_MOST_OBJECTS = 100
"""Largest number of rows in the table of objects. The layout of the largest possible table takes minutes."""


def evaluate_run(
    run: RunFolder,
    /,
    *,
    speed: bool = True,
    compute: ComputeOptions = ComputeOptions(),
) -> None:
    """Score a run on its test views and write RUN/metrics.json, and RUN/errors.png with maps of the errors.

    Args:
        run: Run folder.
        speed: Measure frames per second. The result is valid only while nothing else runs.
    """
    trained, reporter = open_run_folder(run, compute)
    record = trained.evaluate(speed=speed, reporter=reporter)
    title = (
        f"{trained.configuration.recipe} on {trained.scene.name}: mean of {len(record['views'])} test views"
    )
    print_scores(record, title)
    health = trained.health
    for warning in health.warnings if health else ():
        warn(warning)
    say(f"polarization: {trained.polarization}")
    say("health: not recorded, the training was not checked" if health is None else health.summary)
    sheet = importlib.import_module("polarguide.results.evaluation.evaluate").ERRORS_FILE
    say(f"metrics: {run / 'metrics.json'}")
    say(f"where the errors are: {run / sheet}")


def print_scores(record: dict[str, Any], title: str) -> None:
    """Print a run's record as tables: its metrics, and its errors by object and material."""
    metrics = importlib.import_module("polarguide.results.evaluation.table")
    table = Table(title=Text(printable(title)))
    table.add_column("metric")
    table.add_column("value", justify="right", overflow="fold")
    for label, text in metrics.shown_metrics(record):
        table.add_row(Text(printable(label)), Text(printable(text)))
    console.print(table)
    for line in metrics.explained(record):
        say(line)
    if absent := metrics.absent_metrics(record):
        say(f"no ground truth, or no such layer, for: {', '.join(absent)}")
    if record["objects"]:
        columns = [metric for metric in metrics.METRICS if metric.key in metrics.OBJECT_METRICS]
        console.print(_errors(record, columns))
        if len(record["objects"]) > _MOST_OBJECTS:
            say(
                f"the {_MOST_OBJECTS} largest of {len(record['objects']):,} objects; metrics.json has all of them"
            )


def _errors(record: dict[str, Any], columns: list[Any]) -> Table:
    """Return a table of the errors by object and by material, over the pixels of all test views."""
    table = Table(title="by object and material, over the pixels of all test views")
    table.add_column("object", no_wrap=True)
    table.add_column("pixels", justify="right", no_wrap=True)
    for metric in columns:
        table.add_column(metric.heading, justify="right", min_width=8)
    headings = {"metal_share": "metal", "undecided_share": "undecided"}
    shares = [
        key for key in headings if any(errors.get(key) is not None for errors in record["objects"].values())
    ]
    for key in shares:
        table.add_column(headings[key], justify="right", no_wrap=True)

    def add(name: str, errors: dict[str, Any]) -> None:
        values = [errors[metric.key] for metric in columns]
        texts = ["n/a" if v is None else f"{v:.{m.digits}f}" for m, v in zip(columns, values, strict=True)]
        values = [errors.get(key) for key in shares]
        texts += ["n/a" if share is None else f"{100 * share:.1f} %" for share in values]
        table.add_row(Text(printable(name)), f"{errors['pixels']:,}", *texts)

    largest = sorted(record["objects"], key=lambda name: -record["objects"][name]["pixels"])[:_MOST_OBJECTS]
    for name in filter(set(largest).__contains__, record["objects"]):
        add(name, record["objects"][name])
    table.add_section()
    for kind, errors in record["materials"].items():
        add(f"all {kind}", errors)
    return table


FRAMES = 120
LAYERS = "final,base,reflection,specular,diffuse,strength,roughness,metalness,normal,depth,dolp,aolp"


def render_run(
    run: RunFolder,
    /,
    *,
    views: str = "test",
    layers: str | None = None,
    path: str = "",
    frames: int = FRAMES,
    size: str = "",
    video: Path | None = None,
    format: PictureFormat = "png",
    transparent: bool = False,
    environment: Path | None = None,
    rotate_environment: float = 0.0,
    out: Path | None = None,
    compute: ComputeOptions = ComputeOptions(),
) -> None:
    """Render a run's layers to PNG, with a contact sheet next to the ground truth; or along a path, as a video.

    specular and diffuse are the contributions that add up to final; normals are in camera space, blue facing the
    camera.

    Args:
        run: Run folder.
        views: test, train, all, or names separated by commas.
        layers: Any of final, base, reflection, specular, diffuse, strength, roughness, metalness, normal, depth,
            alpha, and the predicted polarization: stokes, dolp, aolp. Default: most of them; along a path, final.
        path: Camera path in place of views: orbit, turntable (so near that the subject fills the picture), spiral,
            interpolate (through the photographs), or a JSON file of cameras.
        frames: Number of pictures along the path (a file has its own).
        size: Size of the pictures along the path, such as 1920x1080, for all layers together.
        video: MP4 file of the path, layers side by side with their names; default: PNG files.
        format: Format of the layers of views: png as a display shows them, or exr and npy with the linear numbers,
            whose units layers.json states. The contact sheet is PNG.
        transparent: Write PNG files of views with a transparent background, without a dark rim around the subject.
        environment: Panorama of linear radiance (.hdr, .exr) that replaces the learned environment.
        rotate_environment: Rotation of the environment in degrees, counter-clockwise seen from above.
        out: Folder to write; default: RUN/render.
    """
    if video is not None and (not path or video.suffix.lower() != ".mp4"):
        raise PolarguideError(
            "video",
            expected="a name that ends in .mp4, and a --path",
            found=f"{video} and {path or 'no path'}",
            remedy="Write for example --path orbit --video film.mp4.",
        )
    if not path and (frames != FRAMES or size):
        raise PolarguideError(
            "size" if size else "frames",
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
    pixels = picture_size(size) if size else None
    if layers is None:
        layers = "final" if path else LAYERS
    names = [name.strip() for name in layers.split(",") if name.strip()]
    trained, reporter = open_run_folder(run, compute)
    trained.relight(environment, rotate_environment, reporter=reporter)
    if path:
        trained.write_film(
            video or out or run / "render",
            path=path,
            layers=names,
            frames=frames,
            size=pixels,
            reporter=reporter,
        )
        return
    sheet = trained.write_pictures(
        out, views=views, layers=names, format=format, transparent=transparent, reporter=reporter
    )
    say(f"pictures: {sheet.parent}   contact sheet: {sheet}")


DEMO_STEPS = 2000
FIRST_VIEW = "v022"
FIRST_LAYERS = ("final", "specular", "diffuse", "normal")
FINER = 3
"""Size of the first picture in units of the photographs' size."""


def demo(
    *,
    out: Path = Path("runs/demo"),
    steps: int = DEMO_STEPS,
    seed: int = 0,
    machine: ThreadOptions = ThreadOptions(),
) -> None:
    """Train, evaluate and render the small scene that ships with the program.

    Args:
        out: Run folder to write; a finished or interrupted demo in it is resumed.
        steps: Optimizer steps.
        seed: Seed of all random numbers.
    """
    scene = polarguide.demo_scene()
    say(f"scene: {scene} (50 views of glossy objects, four polarizer angles each)")
    train_scene(
        scene,
        out=out,
        settings=TrainSettings(steps, seed),
        session=SessionOptions(threads=machine.threads),
        resume=(out / "run.json").exists(),
    )
    evaluate_run(out, compute=ComputeOptions(machine.threads))
    render_run(out)
    picture = _first_picture(out)
    say(f"look at {picture}: {FIRST_VIEW}, which training has not seen, and its layers")
    say(
        f"then at {out / 'render' / 'contact_sheet.png'}: rows are views, columns are layers, each beside the true "
        "one if it is known"
    )
    say(f"look around: {command('view', out)}")


def _first_picture(out: Path) -> Path:
    """Write a held-out view with its layers, larger than its photograph, and return the path."""
    figures = importlib.import_module("polarguide.visualization.figures")
    run = polarguide.open_run(out)
    camera = run.scene.view(FIRST_VIEW).camera
    camera = camera.scaled(FINER, FINER * camera.width, FINER * camera.height)
    result = run.result(camera).to("cpu")
    tiles = [figures.layer_picture(result, name, camera) for name in FIRST_LAYERS]
    path = out / "first_picture.png"
    figures.write_png(path, figures.contact_sheet([tiles], [FIRST_VIEW], FIRST_LAYERS))
    return path


def view_in_browser(
    run: RunFolder,
    /,
    *,
    host: str = LOOPBACK[0],
    port: int = 8080,
    beside: Path | None = None,
    visitors: VisitorOptions = VisitorOptions(),
    compute: ComputeOptions = ComputeOptions(),
) -> None:
    """Show a run in a browser: its layers from any side, next to the photographs. Ctrl-C ends it.

    Args:
        run: Run folder.
        host: Address of the server. Other machines can connect only to an address of the network (0.0.0.0: any).
        port: Port of the server; the next free port is taken if it is in use.
        beside: Another run of the same scene, such as one without polarization, for a wipe between the two.
    """
    if run.is_file():
        raise PolarguideError(
            run,
            expected="a run folder: what train wrote under --out, with run.json in it",
            found=f"a file ({run.suffix or 'without a suffix'})",
            remedy=f"{command('view', run.parent)} if it lies in one. Files of Gaussians alone, without the light that "
            "they reflect, are for other viewers (SuperSplat).",
        )
    require_package("viser", "the viewer")
    trained, reporter = open_run_folder(run, compute)
    other = None if beside is None else open_run_folder(beside, compute)[0]
    trained.view(host=host, port=port, visitors=visitors, reporter=reporter, beside=other)


def share_run(
    run: RunFolder,
    /,
    *,
    out: Path | None = None,
    title: str = "",
    caption: str = "",
    machine: ThreadOptions = ThreadOptions(),
) -> None:
    """Write a run as one self-contained web page that renders it with its reflections.

    Args:
        run: Run folder.
        out: File to write; default: RUN/share.html.
        title: Heading of the page; default: the scene's name.
        caption: Text below the heading; default: the recipe and its steps.
    """
    trained, reporter = open_run_folder(run, machine)
    path = trained.share(out, title=title, caption=caption, reporter=reporter)
    say(f"page: {path} ({size_text(path.stat().st_size)})")


def export_run(
    run: RunFolder,
    /,
    *,
    format: ExportFormat,
    out: Path | None = None,
    resolution: int = 192,
    spz_version: Literal[3, 4] = 3,
    fields: PlyFields = "release",
    axes: Axes = "upright",
    model: Annotated[ModelOptions, tyro.conf.arg(name="")] = ModelOptions(),
    normals: Annotated[NormalOptions, tyro.conf.arg(name="")] = NormalOptions(),
    machine: ThreadOptions = ThreadOptions(),
) -> None:
    """Export a run to the file formats of other programs.

    Splats (ply, spz, splat-glb, splat-usdz) have reflections baked into harmonics. The mesh (GLB and PLY) is fused
    from rendered depth and has diffuse colors and learned normals. The textured model (glb, usdz) is for Blender, game
    engines and viewers. Its base color has no highlights and no shading. Its closed surface (stl) is for 3D printing.
    The environment is the learned light as a panorama (EXR, HDR and PNG). The cameras are a COLMAP model and
    transforms.json. The normals are poses, pictures and normal maps for trainers with a normal loss. The choice all is
    a package of most of these.

    Args:
        run: Run folder.
        format: ply, spz, splat-glb, splat-usdz, mesh, glb, usdz, stl, environment, cameras, normals or all.
        out: Folder to write; default: RUN/export.
        resolution: Voxels of the mesh along its longest side.
        spz_version: Version of the SPZ file; programs support only one of the two.
        fields: Fields of ply: release has those of every 3DGS file; all adds polarguide.ply, with linear colors,
            strength, roughness and more, for programs that read fields by name.
        axes: upright (+y in GLB and USD, -y elsewhere), or the axes of the scene, except in GLB and USD.
    """
    for package in EXPORT_PACKAGES.get(format, ()):
        require_package(package, f"--format {format}")
    trained, reporter = open_run_folder(run, machine)
    for path in trained.export(
        format,
        out,
        resolution=resolution,
        spz_version=spz_version,
        fields=fields,
        axes=axes,
        model=model,
        normals=normals,
        reporter=reporter,
    ):
        size = f" ({size_text(path.stat().st_size)})" if path.is_file() else ""
        say(f"{format}: {path}{size}")


CONFIGURATION = "run.json"
"""File that a training writes at its start."""
INSPECTION = "inspection.json"
"""File that contains the verdict of an inspection."""


@dataclass(frozen=True)
class InspectionSummary:
    """Fields of an inspection record that this verb reads.

    Attributes:
        verdict: verdict of the inspection.
        scene: description of the inspected scene.
    """

    verdict: str
    scene: dict[str, Any]


def run_folder(
    source: Annotated[Path, tyro.conf.Positional],
    /,
    *,
    out: Path | None = None,
    sensor: SensorName | None = None,
    angles: str | None = None,
    shots_per_view: int | None = None,
    recipe: str | None = None,
    steps: int | None = None,
    downscale: int | None = None,
    open: bool = False,
    view: bool = True,
    threads: int | None = None,
    device: DeviceName | None = None,
) -> None:
    """Go from a folder of pictures to a scene in a browser: prepare, inspect, train, eval and view.

    Prints what the folder contains, and the commands that follow. Ctrl-C stops at any point, and the same command
    resumes. For other options, use the printed commands: a scene that prepare wrote is also a valid folder.

    Args:
        source: Folder of photographs, of shots through a polarizing filter, or of raw mosaics; a video; a published
            dataset; or a scene folder with poses.
        out: Folder to write, with scene/, inspection/ and run/. Default: runs/NAME, after the folder's name.
        sensor: Sensor of raw mosaics, such as IMX250MYR.
        angles: Polarizer angles of shots whose names state none, in the order of the files, such as 0,45,90,135; or
            unknown; or none for photographs without a filter.
        shots_per_view: Number of consecutive pictures of one view. By default, it is detected.
        recipe: Method of the training; default: polarguide-stokes.
        steps: Optimizer steps of the training.
        downscale: Factor by which the training reduces the pictures.
        open: Show the training in a browser, at the printed address.
        view: Open the viewer at the end.
        threads: Number of threads; default: all cores.
        device: Device of the computation: auto, cpu or cuda.
    """
    folder = out or Path("runs") / canonical(
        source.resolve().stem if source.is_file() else source.resolve().name
    )
    settings = PrepareSettings(sensor=sensor, angles=angles, shots_per_view=shots_per_view)
    preparation = _flags(sensor=sensor, angles=angles, shots_per_view=shots_per_view)
    training = _flags(recipe=recipe, steps=steps, downscale=downscale)
    machine = _flags(threads=threads)
    compute = [*machine, *_flags(device=device)]
    posed = importlib.import_module("polarguide.capture.layout").is_posed_scene(source)
    _require_usable(source, folder, preparation if posed else [])
    TrainSettings(steps=steps)
    SceneOptions(downscale=1 if downscale is None else downscale)
    if recipe is not None:
        importlib.import_module("polarguide.methods").recipe_named(recipe)
    scene = source if posed else folder / "scene"
    commands = [
        ["prepare", str(source), "--out", str(scene), *preparation, *machine],
        ["inspect", str(scene), "--out", str(folder / "inspection"), *compute],
        [
            "train",
            str(scene),
            "--out",
            str(folder / "run"),
            *training,
            *(["--viewer"] if open else []),
            *compute,
        ],
        ["eval", str(folder / "run"), *compute],
        ["view", str(folder / "run"), *compute],
    ]
    commands = commands[posed : len(commands) if view else -1]
    recognized = "a scene with poses"
    if not posed:
        opening = importlib.import_module("polarguide.preparation.open_source")
        recognized = opening.describe_source(source, settings)
    say(f"recognized: {recognized}")
    for words in commands:
        say(f"  {command(*words)}")
    for words in commands:
        _call(words, scene, folder)


def _flags(**values: object) -> list[str]:
    """Return the options that have a value as words of a command line."""
    return [
        word
        for name, value in values.items()
        if value is not None
        for word in (option_name(name), str(value))
    ]


def _require_usable(source: Path, folder: Path, unused: Sequence[str]) -> None:
    """Refuse options without effect, and an output folder that belongs to another command.

    Raises:
        PolarguideError: an option has no effect on the source, or ``folder`` is the run folder of train.
    """
    require(
        not unused,
        source,
        expected="no options of prepare, because it is a prepared scene",
        found=" ".join(unused),
        remedy="Omit these options, or specify the folder of the camera files.",
    )
    require(
        not (folder / CONFIGURATION).exists(),
        folder,
        expected="a new folder, or a folder that polarguide run wrote",
        found=f"{CONFIGURATION} of a training",
        remedy="Choose another folder with --out.",
    )


def _call(words: Sequence[str], scene: Path, folder: Path) -> None:
    """Call a verb. An inspection of the unchanged scene is not repeated, and a training is resumed."""
    verb = words[0]
    resume = verb == "train" and (folder / "run" / CONFIGURATION).exists()
    say("")
    if verb == "inspect" and _is_current(folder / "inspection" / INSPECTION, scene):
        say(f"inspected before: {folder / 'inspection' / 'inspection.html'}")
    else:
        line = [*words, "--resume"] if resume else words
        say(f"> {command(*line)}")
        try:
            app.call(verb, line)
        except KeyboardInterrupt:
            say("To continue, repeat the same polarguide run command.")
            raise
    if verb == "inspect" and _verdict(folder) == "wrong":
        warn(
            "the verdict of the inspection is wrong, so the result may be wrong. The training starts nevertheless."
        )


def _verdict(folder: Path) -> str:
    """Return the verdict of the inspection."""
    return read_record(folder / "inspection" / INSPECTION, InspectionSummary).verdict


def _is_current(record: Path, scene: Path) -> bool:
    """Return True if the record of an inspection is of this scene and newer than all its files."""
    if not record.is_file():
        return False
    inspected = read_record(record, InspectionSummary).scene.get("path")
    newest = max(path.stat().st_mtime_ns for path in scene.rglob("*"))
    return inspected == printable(str(scene.resolve())) and record.stat().st_mtime_ns > newest
