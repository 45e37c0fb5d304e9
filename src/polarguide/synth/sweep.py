"""Parameter sweeps: scenes that differ in one parameter, for controlled studies."""

from __future__ import annotations

import json
import math
import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from polarguide.errors import PolarguideError
from polarguide.progress import Reporter
from polarguide.synth import folder
from polarguide.synth.build import build_scene
from polarguide.synth.cameras import held_out_names, place_cameras, view_names
from polarguide.synth.manifest import verify_scene, write_manifest
from polarguide.synth.render import Plan, synthesize, write_sparse
from polarguide.synth.schema import SceneSpec
from polarguide.synth.settings import Overrides, SynthSettings
from polarguide.synth.variant import choose_variant

PARAMETERS = ("views", "noise", "roughness", "index", "spacing")


@dataclass(frozen=True)
class Sweep:
    """A parameter and its values, in rising order."""

    parameter: str
    values: tuple[float, ...]


def parse_sweep(text: str) -> Sweep:
    """``noise=0,1,2`` -> Sweep.

    Raises:
        PolarguideError: it has another form.
    """
    parameter, _, listed = text.partition("=")
    try:
        values = tuple(sorted({float(value) for value in listed.split(",")}))
    except ValueError:
        values = ()
    if not all(math.isfinite(value) for value in values):
        values = ()
    whole = parameter != "views" or all(value == int(value) and value >= 2 for value in values)
    if parameter not in PARAMETERS or not values or not whole:
        raise PolarguideError(
            "--sweep",
            expected=f"one of {', '.join(PARAMETERS)} with values, such as noise=0,1,2 or views=9,18,36",
            found=repr(text),
            remedy="docs/reference/scene-files.md has examples.",
        )
    return Sweep(parameter, values)


def sweep_scenes(
    spec: SceneSpec, out: Path, settings: SynthSettings, overrides: Overrides, sweep: Sweep, reporter: Reporter, *,
    threads: int = 0,
) -> list[Path]:  # fmt: skip
    """Write ``out/<parameter>-<value>`` for every value, such as ``views-06`` and ``views-12``.

    A sweep over ``views`` (their number in training) renders the scene once, as it is, and makes the smaller scenes by
    leaving out training views evenly, so that all share their test views and even their pictures.
    """
    plans = sweep_plans(spec, out, settings, overrides, sweep)
    if sweep.parameter == "views":
        return _fewer_views(plans[0], out, sweep, reporter, threads)
    done = []
    for value, plan in zip(sweep.values, plans, strict=True):
        done.append(synthesize(plan.spec, plan.out, plan.settings, reporter, threads=threads))
        _note(done[-1], sweep.parameter, value)
    return done


def sweep_plans(
    spec: SceneSpec, out: Path, settings: SynthSettings, overrides: Overrides, sweep: Sweep
) -> list[Plan]:
    """The scenes that a sweep renders, in the order of its values; of a sweep over ``views`` the one with all views."""
    if sweep.parameter == "views":
        return [Plan(overrides.apply(spec), settings, out / "all")]
    plans = []
    for value in sweep.values:
        one, how = overrides, settings
        if sweep.parameter == "noise":
            how = replace(settings, noise=value)
        else:
            change: dict[str, Any] = {sweep.parameter: value}
            one = replace(overrides, **change)
        plans.append(Plan(one.apply(spec), how, _member(out, sweep, value)))
    return plans


def _member(out: Path, sweep: Sweep, value: float) -> Path:
    """The folder of one value; zeros before it, so that names sort like numbers: views-06, views-12."""
    digits = max(len(str(int(other))) for other in sweep.values)
    whole, *rest = f"{value:g}".split(".")
    return out / f"{sweep.parameter}-{'.'.join([whole.zfill(digits), *rest])}"


def _note(scene: Path, parameter: str, value: float) -> None:
    """Write the number under study into ``scene.json``."""
    record = json.loads((scene / "scene.json").read_text(encoding="utf-8"))
    record["study"] = {"parameter": parameter, "value": value}
    folder.write_file(scene / "scene.json", json.dumps(record, indent=1).encode())


def _fewer_views(plan: Plan, out: Path, sweep: Sweep, reporter: Reporter, threads: int) -> list[Path]:
    """All members of a sweep over the number of training views, from the scene with all of them."""
    spec, settings = plan.spec, plan.settings
    cameras = place_cameras(spec.camera, settings.width, settings.height, settings.seed)
    by_name = dict(zip(view_names(len(cameras)), cameras, strict=True))
    tests = held_out_names(list(by_name), settings.test_every)
    train = [name for name in by_name if name not in tests]
    if sweep.values[-1] > len(train):
        raise PolarguideError(
            "--sweep",
            expected=f"up to {len(train)} training views",
            found=f"{sweep.values[-1]:g}",
            remedy=f"The scene has {len(cameras)} views; give --views to render more.",
        )
    whole = synthesize(spec, plan.out, settings, reporter, threads=threads)
    record = json.loads((whole / "scene.json").read_text(encoding="utf-8"))
    done = []
    for value in sweep.values:
        member = _member(out, sweep, value)
        done.append(member)
        if (member / "scene.json").exists():
            verify_scene(member)
            continue
        chosen = [train[k] for k in np.unique(np.linspace(0, len(train) - 1, int(value)).round().astype(int))]
        names = sorted([*chosen, *tests])
        _link(whole, member, names)
        variant = choose_variant(settings.color, threads=threads)
        built = build_scene(spec, member, variant)
        some = [by_name[name] for name in names]
        write_sparse(built, some, names, tests, member, settings)
        smaller = {**record, "views": names, "train": chosen, "sha256": write_manifest(member)}
        folder.write_file(member / "scene.json", json.dumps(smaller, indent=1).encode())
        _note(member, "views", value)
        reporter.say(f"{member}: {len(chosen)} training views")
    return done


def _link(whole: Path, member: Path, names: list[str]) -> None:
    """Share the files of views between two scenes: one file under two names where the disk allows it."""
    for name in names:
        ground_truth = (whole / "gt" / f"{name}.npz").exists()
        raw = (whole / "raw" / f"{name}.png").exists()
        for source in folder.view_files(whole, name, ground_truth=ground_truth, raw=raw):
            target = member / source.relative_to(whole)
            if target.exists():
                continue
            target.parent.mkdir(parents=True, exist_ok=True)
            try:
                os.link(source, target)
            except OSError:
                folder.write_file(target, source.read_bytes())
