"""``polarguide bench``: render the scenes of the bench where they are missing, and compare its rows on them."""

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
from polarguide_synth.render import Plan, expected_time, synthesize
from polarguide_synth.schema import SceneSpec
from polarguide_synth.settings import Overrides, find_scene

SCENES = "scenes"


def run_bench(
    out: PathLike,
    options: BenchOptions,
    *,
    bench: Bench = BENCH,
    reporter: Reporter = SILENT,
) -> Results | None:
    """Render what is missing of one half of the bench, then compare the rows on it.

    Writes the scenes to ``scenes/NAME`` of ``out``, and the comparison to its ``development`` or ``held-back``. What is
    finished is checked and not repeated; after a KeyboardInterrupt the same call goes on.

    Args:
        out: folder to write.
        options: which half and which of its scenes, and on what to compute.
        bench: scenes, rows and settings.
        reporter: receives messages and progress, and the SHA-256 of every scene.

    Returns:
        The results of the comparison, or None if nothing was to be trained.

    Raises:
        PolarguideError: a scene of ``out`` is of other settings or another version of its preset, or a file of it has
            changed; Mitsuba is missing and not all is rendered; as ``compare``. Nothing is written before all scenes
            have been looked at.
    """
    specs = {name: Overrides(views=bench.views).apply(find_scene(name)) for name in options.chosen(bench)}
    refuse_scene(Path(out))
    rows = {} if options.render_only else dict(bench.rows)
    for name in rows:  # hours of rendering should not end in a wrong name
        recipe_named(name)
    if options.local:
        choose_backend(options.device)
    lacking = missing_package() if rows else None
    if lacking is not None:
        reporter.warn(f"mesh scores will have no value: {lacking}")
    places = {name: Path(out) / SCENES / spec.name for name, spec in specs.items()}
    states = {name: _state(places[name], spec, bench) for name, spec in specs.items()}
    threads = options.jobs * options.threads
    plans = [Plan(spec, bench.synth, places[name]) for name, spec in specs.items()]
    expected_time(plans, reporter, threads=threads)  # an error now where there is no Mitsuba
    make_folder(Path(out) / SCENES)
    with locked(Path(out) / SCENES):
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
    """How far the rendering of a scene is; a finished one is compared with its checksums.

    Raises:
        PolarguideError: the folder holds something else, or the scene differs from that of the bench.
    """
    try:
        state = folder_state(place, scene_request(spec, bench.synth))
        if state == "finished":
            verify_scene(place)
    except PolarguideError as error:
        raise PolarguideError(
            error.where,
            expected=f"{error.expected}, as this version's bench renders {spec.name}",
            found=error.found,
            remedy=f"Remove {place} to render it anew, or give another --out.",
        ) from error
    return state


def _command(out: PathLike, options: BenchOptions, places: Mapping[str, Path]) -> str:
    """The command line that asks for this."""
    line = ["polarguide", "bench", "--out", str(out)]
    line += ["--held-back"] if options.held_back else []
    line += ["--scenes", *places] if options.scenes else []
    return shlex.join(line)
