"""Render scene folders with ground truth."""

from __future__ import annotations

import io
import json
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
from polarguide.core.progress import Reporter
from polarguide.geometry.camera import Camera
from polarguide_synth import folder
from polarguide_synth.build import BuiltScene, build_scene
from polarguide_synth.colmap import place_cameras, sample_sparse_points, write_model
from polarguide_synth.folder import scene_record, verify_scene, write_manifest
from polarguide_synth.ground_truth import ground_truth_maps, write_sheet
from polarguide_synth.mesh import Array
from polarguide_synth.schema import SceneSpec, require_unicode
from polarguide_synth.sensor import (
    FilterShot,
    LobeRadiance,
    Sensor,
    exposure_suffix,
    filter_jpeg,
    mosaic,
    noisy,
    plan_shot,
    render_lobes,
)
from polarguide_synth.settings import LONG_SECONDS, PATHS_PER_SECOND, SynthSettings, rough_time, start_mitsuba
from polarguide_synth.transport import PathLimits

TEST_SAMPLES = 4
"""Ratio of the samples per pixel in held-out views to those in training views."""
METER_VIEWS = 4
"""Largest number of views from which the exposure is measured."""
METER_SAMPLES = 16
"""Samples per pixel of the views from which the exposure is measured."""
METER_WIDTH = 64
"""Approximate width in pixels of the views from which the exposure is measured."""
BRIGHT = 1.5
"""Value of S0 that 1 % of the pixels exceed at automatic exposure. It is three quarters of full scale."""


@dataclass(frozen=True, eq=False)
class Plan:
    """A rendering that is planned. Creating a plan neither loads nor writes anything."""

    spec: SceneSpec
    settings: SynthSettings
    out: Path

    def checked_state(self) -> folder.State:
        """Return how far the rendering in the folder has progressed.

        Raises:
            PolarguideError: a setting is invalid, or the folder contains other files.
        """
        self.settings.check()
        require_unicode(self.out)
        return folder.folder_state(self.out, folder.scene_request(self.spec, self.settings))

    @cached_property
    def names(self) -> list[str]:
        """Names of all views: ``v000``, ``v001``, ..."""
        count = self.spec.camera.views
        digits = max(3, len(str(count - 1)))
        return [f"v{number:0{digits}d}" for number in range(count)]

    @cached_property
    def tests(self) -> list[str]:
        """Names of the held-out views. Empty if there is only one view."""
        return self.names[:: self.settings.test_every] if len(self.names) > 1 else []

    def unfinished(self) -> list[int]:
        """Return the numbers of the views that are not finished yet."""
        return [
            number
            for number, name in enumerate(self.names)
            if not all(file.exists() for file in self.files(name))
        ]

    def paths_left(self) -> int:
        """Return the number of light paths that the unfinished views need."""
        views = sum(TEST_SAMPLES if self.names[number] in self.tests else 1 for number in self.unfinished())
        return self.settings.width * self.settings.height * self.settings.samples * views

    @property
    def mosaics(self) -> bool:
        """True if the rendering also writes raw mosaics."""
        return self.settings.sensor in SENSORS

    def photographs(self, number: int) -> list[tuple[FilterShot, Path]]:
        """Return the exposures of the photograph of a view, and their files. Empty if the sensor is not ``filter``."""
        if self.settings.sensor != "filter":
            return []
        shot = plan_shot(self.settings.seed, number)
        name = f"{self.names[number]}_a{shot.body_angle}"
        stops = self.settings.stops
        return [
            (replace(shot, stops=shot.stops + stop), self.out / "raw" / f"{name}{suffix}.jpg")
            for stop, suffix in zip(stops, exposure_suffix(stops), strict=True)
        ]

    def raw_mosaics(self, name: str) -> list[Path]:
        """Return the files of the exposures of a view's mosaic. Empty for other sensors."""
        suffixes = exposure_suffix(self.settings.stops) if self.mosaics else []
        return [self.out / "raw" / f"{name}{suffix}.png" for suffix in suffixes]

    def has_ground_truth(self, name: str) -> bool:
        """Return True if the ground truth of a view is written."""
        return self.settings.ground_truth == "all" or name in self.tests

    def files(self, name: str) -> list[Path]:
        """Return the paths of all files of a view."""
        files = folder.view_files(self.out, name, ground_truth=self.has_ground_truth(name))
        photographs = [path for _, path in self.photographs(self.names.index(name))]
        return [*files, *self.raw_mosaics(name), *photographs]


@dataclass(frozen=True, eq=False)
class Job(Plan):
    """A rendering whose scene is in memory.

    Attributes:
        built: scene of Mitsuba.
        cameras: cameras of the views.
        exposure: factor from radiance to the values of the pictures.
        sensor: parameters of the simulated sensor.
    """

    built: BuiltScene
    cameras: list[Camera]
    exposure: float
    sensor: Sensor


def report_expected_time(plans: Sequence[Plan], reporter: Reporter, *, threads: int = 0) -> None:
    """Report how long the unfinished views of scenes take, if this is more than an hour. Nothing is written.

    Args:
        plans: the scenes.
        reporter: receiver of the estimate.
        threads: number of threads; 0 uses all cores.

    Raises:
        PolarguideError: for the same reasons as in ``synthesize``.
    """
    unfinished = [plan for plan in plans if plan.checked_state() != "finished"]
    if unfinished:
        start_mitsuba(threads=threads)
    paths_per_second = PATHS_PER_SECOND * (threads or os.cpu_count() or 1)
    seconds = sum(plan.paths_left() for plan in unfinished) / paths_per_second
    if seconds > LONG_SECONDS:
        reporter.say(
            f"Rendering will take {rough_time(seconds)}. Repeat the command to resume a stopped rendering."
        )


def synthesize(
    spec: SceneSpec, out: Path, settings: SynthSettings, reporter: Reporter, *, threads: int = 0
) -> Path:
    """Render a scene, or resume a rendering that was stopped.

    Args:
        spec: the scene.
        out: folder to write.
        settings: settings of the rendering.
        reporter: receiver of progress and messages.
        threads: number of threads; 0 uses all cores.

    Returns:
        The folder.

    Raises:
        PolarguideError: Mitsuba is missing, the folder contains other files, or the scene is invalid.
    """
    plan = Plan(spec, settings, out)
    state = plan.checked_state()
    if state == "finished":
        verify_scene(out)
        reporter.say(f"{out} is finished. The checksums of all files match.")
        return out
    start_mitsuba(threads=threads)
    if state == "new":
        request = folder.scene_request(spec, settings)
        folder.write_file(out / folder.REQUEST, json.dumps(request, indent=1).encode())
    names = plan.names
    built = build_scene(spec, out)
    cameras = place_cameras(spec.camera, settings.width, settings.height, settings.seed)
    exposure = spec.exposure or _metered_exposure(built, cameras, settings.seed)
    job = Job(spec, settings, out, built, cameras, exposure, Sensor())
    _render_all(job, reporter)
    write_sparse(built, cameras, names, plan.tests, out, settings)
    record = scene_record(
        spec,
        settings,
        names,
        plan.tests,
        exposure=exposure,
        clipped=folder.clipped_share(out, names),
    )
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
    """Render the unfinished views."""
    unfinished = job.unfinished()
    finished = len(job.names) - len(unfinished)
    if finished:
        reporter.say(f"Resuming: {finished} of {len(job.names)} views are finished.")
    with reporter.track(f"rendering {job.spec.name}", len(job.names)) as progress:
        progress(finished)
        for count, number in enumerate(unfinished, finished + 1):
            render_view(job, number)
            progress(count)


def render_view(job: Job, number: int) -> None:
    """Render one view and write its files."""
    settings = job.settings
    name = job.names[number]
    camera = job.cameras[number]
    big = camera
    samples = settings.samples * (TEST_SAMPLES if name in job.tests else 1)
    if job.mosaics:
        big = camera.scaled(2, 2 * camera.width, 2 * camera.height)
        samples = max(1, samples // 4)
    limits = PathLimits(job.spec.depth, job.spec.clamp / job.exposure, visible_only=job.spec.object_only)
    light = render_lobes(job.built.scenes, big, samples, seed=settings.seed * 100003 + number, limits=limits)
    random = np.random.default_rng((settings.seed, 31, number))
    if job.mosaics:
        stokes = light.stokes * job.exposure
        for stop, path in zip(settings.stops, job.raw_mosaics(name), strict=True):
            raw = mosaic(stokes, settings.sensor, settings.noise, random, job.sensor, 2.0**stop)
            write_png_file(path, raw)
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
    for shot, path in job.photographs(number):
        rays = camera.rays(dtype=torch.float64).numpy()
        folder.write_file(path, filter_jpeg(stokes, rays, shot, settings.noise, random, job.sensor))
    # Only the files of a simulated sensor contain noise. These pictures are their noise-free reference.
    noise = settings.noise if settings.sensor == "ideal" else 0.0
    write_view(
        job.out, name, folder.sensor_codes(stokes, lambda values: noisy(values, noise, random, job.sensor))
    )


def write_sparse(
    built: BuiltScene,
    cameras: list[Camera],
    names: list[str],
    tests: list[str],
    out: Path,
    settings: SynthSettings,
) -> None:
    """Write the COLMAP model of rendered views, and the split into training and held-out views.

    Args:
        built: the scene.
        cameras: cameras of the views.
        names: names of the views.
        tests: names of the held-out views.
        out: scene folder.
        settings: number and seed of the points.
    """
    sparse = sample_sparse_points(
        built, cameras, [folder.photograph(out, name) for name in names], settings.points, settings.seed
    )
    write_model(out / "sparse" / "0", cameras, names, sparse)
    folder.write_file(out / "split.json", json.dumps({"test": tests}).encode())


def _metered_exposure(built: BuiltScene, cameras: list[Camera], seed: int) -> float:
    """Return the exposure at which 1 % of the pixels exceed ``BRIGHT``, measured in some small pictures."""
    values = []
    for camera in cameras[:: -(-len(cameras) // METER_VIEWS)]:
        factor = max(1, camera.width // METER_WIDTH)
        limits = PathLimits(built.spec.depth, visible_only=built.spec.object_only)
        light = render_lobes(built.scenes, camera.downscaled(factor), METER_SAMPLES, seed=seed, limits=limits)
        values.append(light.stokes[0].ravel())
    return float(f"{BRIGHT / max(float(np.percentile(np.concatenate(values), 99)), 1e-9):.4g}")


def _halved(values: Array) -> Array:
    """Average blocks of 2x2 pixels: an array [..., 2H, 2W, 3] becomes [..., H, W, 3]."""
    *lead, height, width, colors = values.shape
    return np.asarray(values.reshape(*lead, height // 2, 2, width // 2, 2, colors).mean(axis=(-4, -2)))
