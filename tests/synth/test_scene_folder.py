"""``polarguide synth`` from end to end on a tiny scene: read again, resumed, refused, prepared."""

import hashlib
import json
import shutil
from pathlib import Path

import msgspec
import numpy as np
import pytest
import scipy.ndimage
from faults import Fault
from tiny_capture import write_picture

from polarguide import optics
from polarguide.capture import load_scene
from polarguide.core.progress import Reporter
from polarguide_synth import render as runner
from polarguide_synth.folder import MANIFEST, photograph, scene_digest
from polarguide_synth.render import synthesize
from polarguide_synth.schema import SceneSpec, parse_scene
from polarguide_synth.settings import Overrides, SynthSettings, rough_time, start_mitsuba

TINY = {
    "name": "tiny",
    "camera": {"rings": [{"radius": 3, "height": 1.2}], "target": [0, 0, 0.4], "views": 4, "fov": 45},
    "environment": {"type": "uniform", "height": 4},
    "exposure": 0.8,
    "depth": 2,
    "things": [
        {"name": "ground", "foreground": False, "shape": {"type": "plane", "size": [6, 6]},
         "material": {"color": {"type": "checker", "pixels": 64}}},
        {"name": "ball", "shape": {"type": "sphere", "radius": 0.6, "detail": 32}, "position": [0, 0, 0.6],
         "material": {"color": [0.2, 0.3, 0.1]}},
    ],
}  # fmt: skip
SETTINGS = SynthSettings(size="16x16", samples=1, points=60)


@pytest.fixture(scope="module")
def spec() -> SceneSpec:
    return parse_scene(json.loads(json.dumps(TINY)), "tiny", folder=Path())


@pytest.fixture(scope="module")
def scene(spec: SceneSpec, mitsuba: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return synthesize(spec, tmp_path_factory.mktemp("synth") / "tiny", SETTINGS, Reporter(), threads=1)


def test_the_folder_is_read_like_a_capture(scene: Path) -> None:
    found = load_scene(scene)
    assert [view.name for view in found.views] == ["v000", "v001", "v002", "v003"]
    assert found.test_names == ("v000",)
    assert found.refractive_index == 1.5
    assert not [text for text in found.warnings if "without a view" in text]
    assert len(found.points) > 20
    (view,) = found.test_views
    ground_truth = view.ground_truth
    stokes = optics.stokes(view.intensities())
    total = ground_truth.specular + ground_truth.diffuse
    everywhere = ground_truth.mask & ~view.saturated
    off = (stokes[0] - total)[everywhere].abs().amax(-1)
    assert off.median() < 5e-4
    assert (
        off < 2e-3
    ).float().mean() > 0.7  # pixels at edges see the sky, too, which belongs to neither layer
    assert json.loads((scene / "scene.json").read_text())["train"] == ["v001", "v002", "v003"]
    assert {path.name for path in (scene / "mesh").iterdir()} == {"ground.ply", "ball.ply"}


def test_points_lie_near_surfaces(scene: Path) -> None:
    points = load_scene(scene).points.numpy().astype(float)
    ground = np.abs(points[:, 2])
    ball = np.abs(np.linalg.norm(points - [0, 0, 0.6], axis=1) - 0.6)
    assert np.median(np.minimum(ground, ball)) < 0.15  # sixteen pixels are coarse


def test_object_only_blackens_all_else_and_nothing_of_the_object(
    scene: Path, spec: SceneSpec, tmp_path: Path
) -> None:
    """Light, ground truth and points of the object are those of the full scene, whose ground it still mirrors."""
    alone = msgspec.structs.replace(spec, object_only=True)
    out = synthesize(alone, tmp_path / "alone", SETTINGS, Reporter(), threads=1)
    with np.load(out / "gt" / "v000.npz") as found, np.load(scene / "gt" / "v000.npz") as full:
        ball = full["objid"] == 2
        inside, near = (scipy.ndimage.binary_erosion(ball), scipy.ndimage.binary_dilation(ball))
        assert inside.sum() > 10
        assert (~near).sum() > 10
        for name in ("stokes", "specular", "diffuse"):
            np.testing.assert_allclose(found[name][..., inside, :], full[name][..., inside, :], rtol=2e-3)
            assert not found[name][..., ~near, :].any()
            assert full[name][..., ~near, :].any()
        for name in ("normal", "depth", "objid", "mask"):
            assert found[name].dtype == full[name].dtype
            np.testing.assert_array_equal(found[name][ball], full[name][ball])
            assert not found[name][~ball].any()
        np.testing.assert_array_equal(found["mask"], ball)
    points = load_scene(out).points.numpy().astype(float)
    off = np.abs(np.linalg.norm(points - [0, 0, 0.6], axis=1) - 0.6)
    assert len(points) > 5
    assert np.median(off) < 0.15
    Fault(str(out), "same settings").raised_by(synthesize, spec, out, SETTINGS, Reporter(), threads=1)


def test_rendering_goes_on_to_the_same_files(
    scene: Path, spec: SceneSpec, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stopped(job: runner.Job, opaque: int) -> None:
        if opaque == 2:
            raise KeyboardInterrupt
        render(job, opaque)

    render = runner.render_view
    out = tmp_path / "again"
    monkeypatch.setattr(runner, "render_view", stopped)
    with pytest.raises(KeyboardInterrupt):
        synthesize(spec, out, SETTINGS, Reporter(), threads=1)
    assert not (out / "scene.json").exists()
    monkeypatch.setattr(runner, "render_view", render)
    synthesize(spec, out, SETTINGS, Reporter(), threads=1)
    for name in (MANIFEST, "scene.json"):
        assert (scene / name).read_text() == (out / name).read_text()


def test_the_files_do_not_depend_on_the_threads(spec: SceneSpec, mitsuba: None, tmp_path: Path) -> None:
    settings = SynthSettings(size="64x48", samples=16, points=60)
    two = Overrides(views=2).apply(spec)
    digests = []
    for threads in (1, 2):
        out = synthesize(two, tmp_path / str(threads), settings, Reporter(), threads=threads)
        digests.append(scene_digest(out))
    start_mitsuba(threads=1)
    assert digests[0] == digests[1]


def test_the_checksums_are_those_of_all_files(scene: Path) -> None:
    data = (scene / MANIFEST).read_bytes()
    assert scene_digest(scene) == hashlib.sha256(data).hexdigest()
    listed = dict(reversed(line.split("  ")) for line in data.decode().splitlines())
    there = {path.relative_to(scene).as_posix() for path in scene.rglob("*") if path.is_file()}
    assert listed.keys() == there - {MANIFEST, "scene.json"}
    assert list(listed) == sorted(listed)
    for name, digest in listed.items():
        assert hashlib.sha256((scene / name).read_bytes()).hexdigest() == digest


@pytest.mark.parametrize("name", ["polar/v001_045.png", "split.json", MANIFEST])
@pytest.mark.parametrize("lost", [False, True])
def test_a_finished_scene_is_verified(
    name: str, lost: bool, scene: Path, spec: SceneSpec, tmp_path: Path
) -> None:
    out = tmp_path / "copy"
    shutil.copytree(scene, out)
    synthesize(spec, out, SETTINGS, Reporter(), threads=1)
    if lost:
        (out / name).unlink()
    else:
        (out / name).write_bytes((out / name).read_bytes() + b"x")
    found = "file" if lost else "other contents"
    Fault(name, "", found).raised_by(synthesize, spec, out, SETTINGS, Reporter(), threads=1)


def test_other_settings_and_other_folders_are_refused(scene: Path, spec: SceneSpec, tmp_path: Path) -> None:
    (tmp_path / "x").write_text("mine")
    for folder, settings, fault in (
        (scene, SynthSettings(size="16x16", samples=2), Fault(str(scene), "same settings")),
        (tmp_path, SETTINGS, Fault(str(tmp_path), "empty folder")),
    ):
        fault.raised_by(synthesize, spec, folder, settings, Reporter())
    Fault("--samples").raised_by(
        lambda: synthesize(spec, tmp_path / "new", SynthSettings(samples=0), Reporter())
    )


def test_the_time_expected_is_of_what_is_left(
    scene: Path, spec: SceneSpec, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Four views, of which the held-out one takes four times as many paths; a finished scene takes none."""
    new = runner.Plan(spec, SETTINGS, tmp_path / "new")
    assert new.paths_left() == 16 * 16 * SETTINGS.samples * (4 + 3)
    monkeypatch.setattr(runner, "PATHS_PER_SECOND", new.paths_left() / (2 * 3600))
    reporter = Reporter()
    said: list[str] = []
    monkeypatch.setattr(reporter, "say", said.append)
    runner.report_expected_time([runner.Plan(spec, SETTINGS, scene)], reporter, threads=1)
    assert said == []
    runner.report_expected_time([new], reporter, threads=1)
    assert "about 2 hours" in said[0]
    assert not new.out.exists()
    begun = tmp_path / "begun"
    shutil.copytree(scene, begun)
    (begun / "scene.json").unlink()
    (begun / "polar" / "v001_045.png").unlink()
    assert runner.Plan(spec, SETTINGS, begun).paths_left() == 16 * 16 * SETTINGS.samples
    assert rough_time(600) == "about 10 minutes"


def test_without_llvm_the_package_is_named(
    spec: SceneSpec, mitsuba: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", str(tmp_path / "none"))
    Fault("synth", "LLVM 16", "does not exist", "libllvm19").raised_by(
        synthesize, spec, tmp_path / "new", SETTINGS, Reporter()
    )
    assert not (tmp_path / "new").exists()


def test_the_photograph_of_a_gray_scene_has_three_channels(tmp_path: Path) -> None:
    """Pictures whose channels are alike are written as gray ones."""
    ramp = np.linspace(0.1, 0.9, 12)[None, :, None].repeat(8, 0)
    for angle in (0, 45, 90, 135):
        write_picture(tmp_path / "polar" / f"v000_{angle:03d}.png", ramp[..., 0])
    shown = photograph(tmp_path, "v000")
    assert shown.shape == (8, 12, 3)
    assert (np.diff(shown[0, :, 0].astype(int)) > 0).all()  # and is not mirrored
