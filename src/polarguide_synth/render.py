"""``polarguide synth``: a scene as data -> a scene folder with ground truth."""

from __future__ import annotations

import io
import json
import math
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch

from polarguide.capture.sensor.pattern import SENSORS
from polarguide.capture.write import write_png_file, write_view
from polarguide.core.errors import PolarguideError
from polarguide.core.progress import Reporter
from polarguide.geometry.camera import Camera
from polarguide_synth import folder
from polarguide_synth.build import BuiltScene, build_scene
from polarguide_synth.colmap import (
    held_out_names,
    place_cameras,
    sample_sparse_points,
    view_names,
    write_model,
)
from polarguide_synth.folder import scene_record, verify_scene, write_manifest
from polarguide_synth.ground_truth import ground_truth_maps, write_sheet
from polarguide_synth.mesh import Array
from polarguide_synth.schema import SceneSpec, require_unicode
from polarguide_synth.sensor import (
    FilterShot,
    LobeRadiance,
    Sensor,
    filter_jpeg,
    mosaic,
    noisy,
    plan_shot,
    render_lobes,
)
from polarguide_synth.settings import LONG_SECONDS, Overrides, SynthSettings, choose_variant, rough_time
from polarguide_synth.transport import PathLimits

TEST_SAMPLES = 4
METER_VIEWS = 4
METER_SAMPLES = 16
METER_WIDTH = 64
BRIGHT = 1.5


@dataclass(frozen=True, eq=False)
class Plan:
    """A planned rendering, complete before anything is loaded or written."""

    spec: SceneSpec
    settings: SynthSettings
    out: Path

    @property
    def request(self) -> dict[str, Any]:
        """The content of the folder's ``request.json``."""
        return folder.scene_request(self.spec, self.settings)

    def checked_state(self) -> folder.State:
        """How far the rendering in the folder is.

        Raises:
            PolarguideError: a setting is wrong, or the folder holds something else.
        """
        self.settings.check()
        require_unicode(self.out)
        return folder.folder_state(self.out, self.request)

    @cached_property
    def names(self) -> list[str]:
        """Of all views."""
        return view_names(self.spec.camera.views)

    @cached_property
    def tests(self) -> list[str]:
        """The names of the views that are held out."""
        return held_out_names(self.names, self.settings.test_every)

    def left(self) -> list[int]:
        """The numbers of the views that are not finished."""
        return [
            number
            for number, name in enumerate(self.names)
            if not all(file.exists() for file in self.files(name))
        ]

    def paths_left(self) -> int:
        """How many paths it takes to finish."""
        views = sum(TEST_SAMPLES if self.names[number] in self.tests else 1 for number in self.left())
        return self.settings.width * self.settings.height * self.settings.samples * views

    @property
    def mosaics(self) -> bool:
        """Whether raw mosaics are written."""
        return self.settings.sensor in SENSORS

    def photograph(self, number: int) -> tuple[FilterShot, Path] | None:
        """How a view is photographed through a filter, and the file; None where it is not."""
        if self.settings.sensor != "filter":
            return None
        shot = plan_shot(self.settings.seed, number)
        return shot, self.out / "raw" / f"{self.names[number]}_a{shot.body_angle}.jpg"

    def has_ground_truth(self, name: str) -> bool:
        """Whether a view gets ground truth."""
        return self.settings.ground_truth == "all" or name in self.tests

    def files(self, name: str) -> list[Path]:
        """The files of a view."""
        files = folder.view_files(self.out, name, ground_truth=self.has_ground_truth(name), raw=self.mosaics)
        photograph = self.photograph(self.names.index(name))
        return files if photograph is None else [*files, photograph[1]]


@dataclass(frozen=True, eq=False)
class Job(Plan):
    """All that the rendering of a view needs."""

    built: BuiltScene
    cameras: list[Camera]
    exposure: float
    sensor: Sensor


def expected_time(plans: Sequence[Plan], reporter: Reporter, *, threads: int = 0) -> float:
    """The seconds that rendering what is left of some scenes may take; nothing is written yet.

    Args:
        plans: the scenes.
        reporter: receives a warning where only Mitsuba's slow variant can be used, and the expected time then or if
            it is long.
        threads: threads to use; 0 takes all cores.

    Raises:
        PolarguideError: as ``synthesize``.
    """
    left = [plan for plan in plans if plan.checked_state() != "finished"]
    if not left:
        return 0.0
    variant = choose_variant(left[0].settings.color, threads=threads)
    seconds = sum(plan.paths_left() for plan in left) / variant.paths_per_second
    if variant.note:
        reporter.warn(variant.note)
    if variant.note or seconds > LONG_SECONDS:
        reporter.say(
            f"Rendering will take {rough_time(seconds)}; a stopped rendering goes on with the same command."
        )
    return seconds


def synthesize(
    spec: SceneSpec, out: Path, settings: SynthSettings, reporter: Reporter, *, threads: int = 0
) -> Path:
    """Render a scene, or go on with a rendering that was stopped.

    Args:
        spec: the scene.
        out: folder to write.
        settings: how.
        reporter: receives progress and messages.
        threads: threads to use; 0 takes all cores.

    Raises:
        PolarguideError: Mitsuba is missing, the folder holds something else, or the scene has a mistake.
    """
    plan = Plan(spec, settings, out)
    state = plan.checked_state()
    if state == "finished":
        verify_scene(out)
        reporter.say(f"{out} is finished already; all its files have their checksums.")
        return out
    variant = choose_variant(settings.color, threads=threads)
    if state == "new":
        folder.write_file(out / folder.REQUEST, json.dumps(plan.request, indent=1).encode())
    names = plan.names
    built = build_scene(spec, out, variant)
    cameras = place_cameras(spec.camera, settings.width, settings.height, settings.seed)
    exposure = spec.exposure or _metered_exposure(built, cameras, settings.seed)
    job = Job(spec, settings, out, built, cameras, exposure, Sensor())
    _render_all(job, reporter)
    write_sparse(built, cameras, names, plan.tests, out, settings)
    clipped = folder.clipped_share(out, names)
    record = scene_record(spec, settings, variant, names, plan.tests, exposure=exposure, clipped=clipped)
    if job.mosaics:
        gains = {str(45 * k): gain for k, gain in enumerate(job.sensor.gains)}
        folder.write_file(out / "calibration.json", json.dumps({"gains": gains}).encode())
        record["sensor"] = {"name": settings.sensor, **asdict(job.sensor)}
    if settings.sensor == "filter":
        record["shots"] = {name: asdict(plan_shot(settings.seed, k)) for k, name in enumerate(names)}
    with_truth = [number for number, name in enumerate(names) if job.has_ground_truth(name)]
    if with_truth:
        write_sheet(out, [names[k] for k in with_truth], [cameras[k] for k in with_truth])
    record["sha256"] = write_manifest(out)
    folder.write_file(out / "scene.json", json.dumps(record, indent=1).encode())
    return out


def _render_all(job: Job, reporter: Reporter) -> None:
    """Render the views that are not finished."""
    left = job.left()
    if len(left) < len(job.names):
        reporter.say(f"Going on: {len(job.names) - len(left)} of {len(job.names)} views are finished.")
    with reporter.track(f"rendering {job.built.spec.name}", len(job.names)) as progress:
        progress(len(job.names) - len(left))
        for count, number in enumerate(left, 1):
            render_view(job, number)
            progress(len(job.names) - len(left) + count)


def render_view(job: Job, number: int) -> None:
    """Render one view and write its files."""
    settings = job.settings
    name = job.names[number]
    camera = job.cameras[number]
    samples = settings.samples * (TEST_SAMPLES if name in job.tests else 1)
    big = camera.scaled(2, 2 * camera.width, 2 * camera.height) if job.mosaics else camera
    if job.mosaics:
        samples = max(1, samples // 4)
    spec = job.built.spec
    limits = PathLimits(spec.depth, spec.clamp / job.exposure, shown_only=spec.object_only)
    light = render_lobes(job.built.scenes, big, samples, seed=settings.seed * 100003 + number, limits=limits)
    random = np.random.default_rng((settings.seed, 31, number))
    if job.mosaics:
        raw = mosaic(light.stokes * job.exposure, settings.sensor, settings.noise, random, job.sensor)
        write_png_file(job.out / "raw" / f"{name}.png", raw)
        light = LobeRadiance(_halved(light.specular), _halved(light.diffuse), _halved(light.emitted))
    stokes = light.stokes * job.exposure
    if job.has_ground_truth(name):
        arrays: dict[str, Any] = ground_truth_maps(job.built, camera)
        arrays["stokes"] = stokes.astype(np.float16)
        arrays["specular"] = (light.specular[0] * job.exposure).astype(np.float16)
        arrays["diffuse"] = (light.diffuse[0] * job.exposure).astype(np.float16)
        data = io.BytesIO()
        np.savez_compressed(data, **arrays)
        folder.write_file(job.out / "gt" / f"{name}.npz", data.getvalue())
    photograph = job.photograph(number)
    if photograph is not None:
        shot, path = photograph
        rays = camera.rays(dtype=torch.float64).numpy()
        folder.write_file(path, filter_jpeg(stokes, rays, shot, settings.noise, random, job.sensor))
    # With a sensor the noise is in its files, and these pictures are what they should lead to.
    noise = settings.noise if settings.sensor == "ideal" else 0.0
    codes = folder.sensor_codes(stokes, lambda values: noisy(values, noise, random, job.sensor))
    write_view(job.out, name, codes)


def write_sparse(
    built: BuiltScene,
    cameras: list[Camera],
    names: list[str],
    tests: list[str],
    out: Path,
    settings: SynthSettings,
) -> None:
    """Write the COLMAP model of rendered views, and the split into training and test views."""
    pictures = [folder.photograph(out, name) for name in names]
    sparse = sample_sparse_points(built, cameras, pictures, settings.points, settings.seed)
    write_model(out / "sparse" / "0", cameras, names, sparse)
    folder.write_file(out / "split.json", json.dumps({"test": tests}).encode())


def _metered_exposure(built: BuiltScene, cameras: list[Camera], seed: int) -> float:
    """The exposure by which 1 % of S0 in some small pictures lies above ``BRIGHT``, three quarters of full scale."""
    values = []
    for camera in cameras[:: -(-len(cameras) // METER_VIEWS)]:
        factor = max(1, camera.width // METER_WIDTH)
        limits = PathLimits(built.spec.depth, shown_only=built.spec.object_only)
        small = camera.downscaled(factor)
        light = render_lobes(built.scenes, small, METER_SAMPLES, seed=seed, limits=limits)
        values.append(light.stokes[0].ravel())
    return float(f"{BRIGHT / max(float(np.percentile(np.concatenate(values), 99)), 1e-9):.4g}")


def _halved(values: Array) -> Array:
    """Means over boxes of 2x2 pixels: [..., 2H, 2W, 3] to [..., H, W, 3]."""
    *lead, height, width, colors = values.shape
    boxes = values.reshape(*lead, height // 2, 2, width // 2, 2, colors)
    return np.asarray(boxes.mean(axis=(-4, -2)))


PARAMETERS = ("views", "noise", "roughness", "index", "spacing")


@dataclass(frozen=True)
class Sweep:
    """A parameter and its values, in rising order."""

    parameter: str
    values: tuple[float, ...]


def parse_sweep(text: str) -> Sweep:
    """``noise=0,1,2`` -> Sweep.

    Raises:
        PolarguideError: the text has another form.
    """
    parameter, _, listed = text.partition("=")
    try:
        values = tuple(sorted({float(value) for value in listed.split(",")}))
    except ValueError:
        values = ()
    least = 2 if parameter == "views" else -math.inf
    possible = all(
        math.isfinite(v) and (parameter != "views" or v.is_integer()) and v >= least for v in values
    )
    if parameter not in PARAMETERS or not values or not possible:
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
    folders = []
    for value, plan in zip(sweep.values, plans, strict=True):
        folders.append(synthesize(plan.spec, plan.out, plan.settings, reporter, threads=threads))
        record = json.loads((folders[-1] / "scene.json").read_text(encoding="utf-8"))
        _write_record(folders[-1], record, sweep.parameter, value)
    return folders


def sweep_plans(
    spec: SceneSpec, out: Path, settings: SynthSettings, overrides: Overrides, sweep: Sweep
) -> list[Plan]:
    """The scenes that a sweep renders, in the order of its values; of a sweep over ``views`` the one with all views."""
    if sweep.parameter == "views":
        return [Plan(overrides.apply(spec), settings, out / "all")]
    plans = []
    for value in sweep.values:
        change: dict[str, Any] = {sweep.parameter: value}
        member = _member(out, sweep, value)
        if sweep.parameter == "noise":
            plans.append(Plan(overrides.apply(spec), replace(settings, **change), member))
        else:
            plans.append(Plan(replace(overrides, **change).apply(spec), settings, member))
    return plans


def _member(out: Path, sweep: Sweep, value: float) -> Path:
    """The folder of one value; zeros before it, so that names sort like numbers: views-06, views-12."""
    digits = max(len(str(int(other))) for other in sweep.values)
    whole, *rest = f"{value:g}".split(".")
    return out / f"{sweep.parameter}-{'.'.join([whole.zfill(digits), *rest])}"


def _write_record(scene: Path, record: dict[str, Any], parameter: str, value: float) -> None:
    """Write ``scene.json`` with the number under study."""
    record = {**record, "study": {"parameter": parameter, "value": value}}
    folder.write_file(scene / "scene.json", json.dumps(record, indent=1).encode())


def _fewer_views(plan: Plan, out: Path, sweep: Sweep, reporter: Reporter, threads: int) -> list[Path]:
    """All members of a sweep over the number of training views, from the scene with all of them."""
    spec = plan.spec
    settings = plan.settings
    cameras = place_cameras(spec.camera, settings.width, settings.height, settings.seed)
    by_name = dict(zip(plan.names, cameras, strict=True))
    train = [name for name in plan.names if name not in plan.tests]
    if sweep.values[-1] > len(train):
        raise PolarguideError(
            "--sweep",
            expected=f"up to {len(train)} training views",
            found=f"{sweep.values[-1]:g}",
            remedy=f"The scene has {len(cameras)} views; give --views to render more.",
        )
    whole = synthesize(spec, plan.out, settings, reporter, threads=threads)
    record = json.loads((whole / "scene.json").read_text(encoding="utf-8"))
    folders = []
    for value in sweep.values:
        member = _member(out, sweep, value)
        folders.append(member)
        if (member / "scene.json").exists():
            verify_scene(member)
            continue
        chosen = [train[k] for k in np.unique(np.linspace(0, len(train) - 1, int(value)).round().astype(int))]
        names = sorted([*chosen, *plan.tests])
        _link(whole, member, names)
        built = build_scene(spec, member, choose_variant(settings.color, threads=threads))
        write_sparse(built, [by_name[name] for name in names], names, plan.tests, member, settings)
        smaller = {**record, "views": names, "train": chosen, "sha256": write_manifest(member)}
        _write_record(member, smaller, "views", value)
        reporter.say(f"{member}: {len(chosen)} training views")
    return folders


def _link(whole: Path, member: Path, names: list[str]) -> None:
    """Share the files of views between two scenes: one file under two names where the disk allows it."""
    for name in names:
        for source in folder.view_files(whole, name, ground_truth=True, raw=True):
            target = member / source.relative_to(whole)
            if source.exists() and not target.exists():
                target.parent.mkdir(parents=True, exist_ok=True)
                try:
                    os.link(source, target)
                except OSError:
                    folder.write_file(target, source.read_bytes())
