"""The verb ``polarguide bench``, which renders the scenes of the bench and compares recipes on them."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from pathlib import Path

from polarguide.capture.layout import refuse_scene
from polarguide.core.errors import PolarguideError
from polarguide.core.files import make_folder
from polarguide.core.options import PathLike
from polarguide.core.progress import SILENT, Reporter
from polarguide.raster import choose_backend
from polarguide.results.evaluation.mesh import missing_package
from polarguide_bench.compare import compare, locked
from polarguide_bench.options import BENCH, Bench, BenchOptions
from polarguide_bench.recipes import recipe_named
from polarguide_bench.results import Results
from polarguide_synth.folder import State, folder_state, scene_digest, scene_request, verify_scene
from polarguide_synth.render import Plan, report_expected_time, synthesize
from polarguide_synth.schema import SceneSpec
from polarguide_synth.settings import Overrides, find_scene


def run_bench(
    out: PathLike,
    options: BenchOptions,
    *,
    bench: Bench = BENCH,
    reporter: Reporter = SILENT,
) -> Results | None:
    """Render the missing scenes of one half of the bench, and compare recipes on all scenes of this half.

    Scenes are written to ``scenes/NAME`` of ``out``, and the comparison to its ``development`` or ``held-back``.
    Finished work is verified and not repeated. After a KeyboardInterrupt the same call resumes.

    Args:
        out: output folder.
        options: half of the bench, selected scenes, and options of the computation.
        bench: scenes, rows and settings.
        reporter: receives messages and progress, and the SHA-256 of each scene.

    Returns:
        The results of the comparison, or None with ``render_only``.

    Raises:
        PolarguideError: a scene in ``out`` was rendered with other settings or another version of its preset, or one of
            its files has changed. A scene is not rendered and Mitsuba is missing. The comparison fails, see
            ``compare``. All scenes are checked before any file is written.
    """
    specs = {name: Overrides(views=bench.views).apply(find_scene(name)) for name in options.chosen(bench)}
    refuse_scene(Path(out))
    rows = {} if options.render_only else dict(bench.rows)
    for name in rows:  # an unknown recipe is reported before hours of rendering
        recipe_named(name)
    if options.local:
        choose_backend(options.device)
    reason = missing_package() if rows else None
    if reason is not None:
        reporter.warn(f"mesh scores will have no value: {reason}")
    scenes = Path(out) / "scenes"
    places = {name: scenes / spec.name for name, spec in specs.items()}
    states = {name: _state(places[name], spec, bench) for name, spec in specs.items()}
    threads = options.jobs * options.threads
    plans = [Plan(spec, bench.synth, places[name]) for name, spec in specs.items()]
    report_expected_time(plans, reporter, threads=threads)  # reports a missing Mitsuba
    make_folder(scenes)
    with locked(scenes):
        for name, spec in specs.items():
            if states[name] != "finished":
                synthesize(spec, places[name], bench.synth, reporter, threads=threads)
            reporter.say(f"{places[name]}   SHA-256 of its checksums.txt: {scene_digest(places[name])}")
    if not rows:
        return None
    return compare(
        list(places.values()),
        list(rows),
        Path(out) / options.half,
        settings=bench.training,
        options=options.comparing(max(rows.values())),
        seeds_of=rows,
        command_line=_command(out, options, places),
        reporter=reporter,
    )


def _state(place: Path, spec: SceneSpec, bench: Bench) -> State:
    """Return the state of a scene's rendering. The files of a finished scene are verified by their checksums.

    Raises:
        PolarguideError: the folder contains unknown files, or its scene differs from the scene of the bench.
    """
    try:
        state = folder_state(place, scene_request(spec, bench.synth))
        if state == "finished":
            verify_scene(place)
        return state
    except PolarguideError as error:
        raise PolarguideError(
            error.where,
            expected=f"{error.expected}, as this version's bench renders {spec.name}",
            found=error.found,
            remedy=f"Remove {place} to render it again, or give another --out.",
        ) from error


def _command(out: PathLike, options: BenchOptions, places: Mapping[str, Path]) -> str:
    half = ["--held-back"] if options.held_back else []
    scenes = ["--scenes", *places] if options.scenes else []
    return shlex.join(["polarguide", "bench", "--out", str(out), *half, *scenes])
