"""``polarguide train``."""

from __future__ import annotations

import json
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import tyro

from polarguide.cli.common import Transfer, console, read_scene, use_threads
from polarguide.errors import PolarguideError
from polarguide.raster import DeviceName
from polarguide.recipes import recipe_named
from polarguide.runs.folder import CHECKPOINT, CONFIGURATION, RunConfiguration, load_checkpoint, recipe_data
from polarguide.runs.train import train_run, watched
from polarguide.training.company import backend_of, company
from polarguide.training.distributed import Ranks
from polarguide.training.trainer import Trainer, TrainSettings
from polarguide.viewer import LOOPBACK


def train(
    scene: Annotated[Path, tyro.conf.Positional],
    /,
    *,
    out: Path,
    recipe: str = "polarguide-stokes",
    steps: int = 5000,
    downscale: int = 1,
    seed: int = 0,
    refractive_index: float = 1.5,
    transfer: Transfer = "linear",
    device: DeviceName = "auto",
    threads: int = 0,
    checkpoint_every: int = 500,
    views_per_step: int = 0,
    resume: bool = False,
    viewer: bool = False,
    viewer_host: str = LOOPBACK[0],
    viewer_port: int = 8080,
) -> None:
    """Train a recipe on a scene.

    Can be stopped with Ctrl-C at any time: the state is saved, and --resume goes on to the same result. Several
    processes share the views of each step: torchrun --nproc-per-node N -m polarguide train ...

    Args:
        scene: Scene folder: polar/<view>_000|_045|_090|_135.png or four folders I-00 I-45 I-90 I-135, and a COLMAP
            model in sparse/0.
        out: Run folder to write (configuration, checkpoint, log, PLY).
        recipe: Which method: polarguide-stokes (renders the measured polarization, too), polarguide (the paper's stages
            with repaired physics), polarguide-paper, 3dgs, 3dgs-dr, ref-gs (these three ignore polarization), or an
            ablation of one, such as polarguide:without-normals.
        steps: Optimizer steps in all. 3,000 show the scene, 5,000 and more settle it.
        downscale: Average the pictures over boxes of this many pixels first.
        seed: Seed of every random draw.
        refractive_index: Of the surfaces: 1.5 for glass, plastic and glaze, 1.33 for water.
        transfer: How the files encode radiance. Polarization needs linear; srgb undoes the display curve of JPEGs.
        device: What to compute on.
        threads: Threads to use; 0 takes all cores.
        checkpoint_every: Steps between two checkpoints: a kill loses at most as many.
        views_per_step: Views whose mean gradient makes a step; 0 takes one for each process (or what the run to resume
            took). Learning rates grow with its square root; steps are steps, so more views are looked at.
        resume: Go on with the run in --out.
        viewer: Look on in a browser while it trains (afterwards: polarguide view).
        viewer_host: Address to listen at. Others can reach it only if you give one of theirs (0.0.0.0: anyone's).
        viewer_port: To listen at; the next free one is taken if it is in use.
    """
    use_threads(threads)
    check_count("--checkpoint-every", checkpoint_every)
    settings = checked_settings(steps, seed, refractive_index)
    chosen = recipe_named(recipe)
    with company(device, out) as ranks:
        leads = ranks.rank == 0
        _check_out(out, resume, ranks)
        settings = replace(settings, views_per_step=_views(views_per_step, ranks, out if resume else None))
        backend = backend_of(ranks, device)
        loaded = read_scene(scene, downscale=downscale, transfer=transfer)
        configuration = RunConfiguration(
            scene=str(scene.resolve()),
            scene_digest=loaded.digest,
            recipe=recipe,
            recipe_data=recipe_data(chosen),
            settings=settings,
            downscale=downscale,
            transfer=transfer,
            device=str(backend.device),
        )
        state = None
        if resume:
            _check_same(RunConfiguration.load(out), configuration, out)
            state = load_checkpoint(out, chosen, backend.device) if (out / CHECKPOINT).exists() else None
        trainer = Trainer(loaded, chosen, settings, backend, state, ranks)
        with watched(trainer, viewer_host, viewer_port) if viewer else nullcontext() as look:
            ranks.barrier()
            if leads:
                out.mkdir(parents=True, exist_ok=True)
                configuration.save(out)
            train_run(trainer, out, checkpoint_every=checkpoint_every, look=look)
    if leads:
        console.print(f"trained: {out}   next: polarguide eval {out}   polarguide view {out}")


def _views(asked: int, ranks: Ranks, resumed: Path | None) -> int:
    """Views a step: as asked, or of the run to resume, or one for each process."""
    if asked:
        check_count("--views-per-step", asked)
    old = RunConfiguration.load(resumed).settings.views_per_step if resumed else 0
    views = asked or old or ranks.world
    if views < ranks.world:
        console.print(
            f"[yellow]warning:[/] {ranks.world - views} of {ranks.world} processes have no view to look at"
        )
    return views


def check_count(name: str, value: int) -> None:
    """Raise PolarguideError unless the value of the flag ``name`` is at least 1."""
    if value < 1:
        raise PolarguideError(name, expected="1 or more", found=str(value), remedy="Give a positive count.")


def checked_settings(steps: int, seed: int, refractive_index: float) -> TrainSettings:
    """The settings of a training from its flags.

    Raises:
        PolarguideError: a value out of range.
    """
    check_count("--steps", steps)
    if not 1.0 < refractive_index < 4.0:
        raise PolarguideError(
            "--refractive-index",
            expected="between 1 and 4",
            found=str(refractive_index),
            remedy="1.5 suits most.",
        )
    return TrainSettings(steps, seed, refractive_index)


def _check_out(out: Path, resume: bool, ranks: Ranks) -> None:
    """Refuse a folder that does not suit, once for all ranks: rank 0 looks, before it writes there itself."""
    problem = _unsuitable(out, resume) if ranks.rank == 0 else None
    if ranks.any(problem is not None):
        raise problem or SystemExit(2)


def _unsuitable(out: Path, resume: bool) -> PolarguideError | None:
    has_run = (out / CONFIGURATION).exists()
    if resume and not has_run:
        return PolarguideError(
            out,
            expected="a run to resume",
            found="no run.json",
            remedy="Leave out --resume, or give the right --out.",
        )
    if not resume and has_run:
        return PolarguideError(
            out,
            expected="a new folder",
            found="a run",
            remedy="Add --resume to go on with it, or give another --out.",
        )
    return None


def _check_same(old: RunConfiguration, new: RunConfiguration, out: Path) -> None:
    for field in ("scene_digest", "recipe", "recipe_data", "settings", "downscale", "transfer"):
        a, b = getattr(old, field), getattr(new, field)
        if a != b:
            if isinstance(a, dict):  # a recipe: show what differs
                keys = [key for key in {**a, **b} if a.get(key) != b.get(key)]
                a, b = ({key: values.get(key) for key in keys} for values in (a, b))
            raise PolarguideError(
                f"{out}/{CONFIGURATION} ({field})",
                expected=json.dumps(a, default=str)[:120],
                found=json.dumps(b, default=str)[:120],
                remedy="Resume with the same scene, flags and program version, or train into a new folder.",
            )
