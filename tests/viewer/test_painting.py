"""Painting materials in the viewer: a disc, a surface that hangs together, undo, and what is saved to the run."""

from pathlib import Path

import pytest
import torch
from fake_browser import FakeClient
from random_runs import ring
from test_presenting import AROUND
from viewer_scenes import photographs, shown

from polarguide.gaussians.gaussians import Gaussians
from polarguide.geometry.camera import Camera
from polarguide.raster.cpu import rasterize_cpu
from polarguide.shading.result import LAYERS
from polarguide.viewer.guard import Refused
from polarguide.viewer.painting import Materials, Paintable, kinds_of
from polarguide.viewer.panel import KINDS, PanelOptions
from polarguide.viewer.server import Viewer
from polarguide.viewer.session import Session

SIDE = 24
RED, GRAY = (0.6, 0.05, 0.05), (0.3, 0.3, 0.3)


def corner() -> Gaussians:
    """A floor, half of it red, and a wall along its far edge: flat Gaussians, ``SIDE`` squared of each."""
    along = torch.linspace(-1, 1, SIDE)
    u, v = (grid.flatten() for grid in torch.meshgrid(along, along, indexing="ij"))
    zero = torch.zeros_like(u)
    floor = torch.stack((u, zero, v), dim=-1)
    wall = torch.stack((u, -1 - v, zero + 1.05), dim=-1)
    colors = torch.tensor(RED).where((u > 0)[:, None], torch.tensor(GRAY))
    count = len(u)
    lying, standing = torch.tensor([-3.0, -8.0, -3.0]), torch.tensor([-3.0, -3.0, -8.0])
    means = torch.cat((floor, wall))
    return Gaussians(
        {
            "means": means + 0.005 * torch.randn(means.shape, generator=torch.Generator().manual_seed(0)),
            "quaternions": torch.tensor([1.0, 0, 0, 0]).expand(2 * count, 4),
            "log_scales": torch.cat((lying.expand(count, 3), standing.expand(count, 3))),
            "opacity_logits": torch.full((2 * count,), 4.0),
            "sh_dc": (torch.cat((colors, torch.tensor(GRAY).expand(count, 3))) - 0.5) / 0.28209479,
        },
        {},
    )


def above() -> Camera:
    """Sees the floor and the wall behind it."""
    return ring(distance=4.0, width=96, height=72)["v4"]  # from -z


def parts() -> dict[str, torch.Tensor]:
    """Which Gaussians of ``corner`` belong to what."""
    means = corner()["means"].detach()
    floor = torch.arange(len(means)) < SIDE * SIDE
    return {"red": floor & (means[:, 0] > 0), "gray": floor & (means[:, 0] < 0), "wall": ~floor}


def place_of(point: tuple[float, float, float]) -> tuple[float, float]:
    """Where the camera sees a point, in shares of the picture."""
    camera = above()
    x, y, z = (camera.rotation @ torch.tensor(point, dtype=torch.float64) + camera.translation).tolist()
    across, down = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    return across / camera.width, down / camera.height


@pytest.mark.parametrize(
    ("name", "point"), [("red", (0.5, 0, 0)), ("gray", (-0.5, 0, 0)), ("wall", (0.2, -0.8, 1.05))]
)
def test_a_surface_ends_at_an_edge_and_where_another_color_begins(
    name: str, point: tuple[float, float, float]
) -> None:
    materials = Materials(corner(), rasterize_cpu)
    count = materials.surface(above(), place_of(point), 1.0, 0.5, 2)
    painted = materials.kinds == 2
    assert count == int(painted.sum())
    own = parts()[name]
    assert float(painted[own].float().mean()) > 0.9
    assert float(painted[~own].float().mean()) < 0.05
    materials.surface(above(), place_of(point), 1.0, 1e4, 2)
    assert bool((materials.kinds == 2).all())  # over any edge


def test_a_disc_is_painted_and_taken_back() -> None:
    materials, camera = Materials(corner(), rasterize_cpu), above()
    assert not materials.undo()
    place = place_of((0.5, 0, 0))
    few = materials.brush(camera, place, 3.0, 2)
    many = materials.brush(camera, place, 9.0, 1)
    assert 0 < 4 * few < many < SIDE * SIDE
    numbers = materials.picture(camera)
    rows, columns = torch.meshgrid(torch.arange(72) + 0.5, torch.arange(96) + 0.5, indexing="ij")
    far = ((columns - 96 * place[0]) ** 2 + (rows - 72 * place[1]) ** 2).sqrt() / 72
    assert bool((numbers[far < 0.06] == 1).all())
    assert bool((numbers[far > 0.13] == 0).all())
    assert materials.undo()
    assert int((materials.kinds == 2).sum()) == few
    assert materials.undo()
    assert not bool(materials.kinds.any())
    assert materials.surface(camera, (0.02, 0.02), 1.0, 0.5, 2) == 0  # sky


def test_pictures_of_all_views_give_back_what_was_painted() -> None:
    materials = Materials(corner(), rasterize_cpu)
    for point, kind in (((0.5, 0, 0), 2), ((-0.5, 0, 0), 1)):
        materials.surface(above(), place_of(point), 1.0, 0.5, kind)
    seen = shown()
    views = [p.view for p in photographs(seen).values()]
    pictures = {view.name: materials.picture(view.camera) for view in views}
    again = kinds_of(corner(), rasterize_cpu, views, pictures)
    assert float((again == materials.kinds).float().mean()) > 0.95
    assert set(again.tolist()) == {0, 1, 2}


class Visit:
    """A session over ``viewer_scenes.shown``, whose every change is drawn at once."""

    def __init__(self) -> None:
        self.seen, self.client, self.saved = shown(), FakeClient(), list[Materials]()
        pictures = photographs(self.seen)

        def save(materials: Materials) -> str:
            self.saved.append(materials)
            return "Saved"

        self.kinds = {name: number for number, name in enumerate(KINDS)}
        paintable = Paintable(lambda: Materials(self.seen.gaussians, self.seen.rasterize), self.kinds, save)
        options = PanelOptions(LAYERS, True, tuple(pictures), False, saves=True, kinds=self.kinds)
        self.session = Session(
            self.client, pictures, AROUND, options, lambda: None, save=lambda _: "Saved", paintable=paintable
        )
        self.session.go("v0")
        self.client.camera.report()

    def draw(self) -> torch.Tensor:
        self.session.draw(self.seen, self.session.due() or "sharp")
        return torch.from_numpy(self.client.scene.pictures[-1][0].astype(int))

    def click(self, across: float, down: float) -> torch.Tensor:
        self.client.scene.click(across, down)
        assert self.session.due() == "sharp"
        return self.draw()


def test_a_visitor_paints_undoes_and_saves() -> None:
    visit = Visit()
    plain = visit.draw()
    visit.client.scene.click(0.5, 0.5)  # no tool is chosen
    assert bool((visit.draw() == plain).all())
    visit.client.control("Paint").value = "brush"
    visit.client.control("Size").value = 20.0  # its Gaussians are large
    painted = visit.click(0.5, 0.5)
    yellow = (painted - plain)[..., 0] - (painted - plain)[..., 2]
    assert int(yellow[20:76, 40:88].max()) > 40
    assert not bool((painted != plain)[:, :8].any())
    assert "metal: " in visit.client.control("status").content
    visit.client.control("Save materials to the run").click()
    visit.draw()
    assert len(visit.saved) == 1
    assert set(visit.saved[0].kinds.tolist()) == {0, 2}
    visit.client.control("Undo").click()
    assert bool((visit.draw() == plain).all())
    visit.client.control("Undo").click()
    visit.draw()
    assert "Nothing is left" in visit.client.control("status").content
    visit.client.control("Paint").value = "off"
    assert not visit.client.scene.listeners


def test_a_pick_of_white_is_no_stroke() -> None:
    visit = Visit()
    visit.client.control("Paint").value = "brush"
    visit.client.control("Pick").value = "white"
    visit.client.scene.click(0.5, 0.5)
    visit.draw()
    visit.client.control("Save materials to the run").click()
    visit.draw()
    assert not bool(visit.saved[0].kinds.any())


def test_only_known_materials_and_tools_are_taken_from_a_browser() -> None:
    visit = Visit()
    accepts, controls = visit.session.panel.accepts, visit.client.gui.controls
    assert accepts[controls["As"]._impl.uuid]("dielectric") == "dielectric"
    assert accepts[controls["Reach"]._impl.uuid](1e9) == 30.0
    for label in ("As", "Paint"):
        with pytest.raises(Refused):
            accepts[controls[label]._impl.uuid]("gold")


@pytest.mark.parametrize(("host", "paints"), [("127.0.0.1", True), ("0.0.0.0", False)])
def test_only_visitors_of_this_machine_paint(host: str, paints: bool, tmp_path: Path) -> None:
    seen = shown()
    paintable = Paintable(lambda: Materials(seen.gaussians, seen.rasterize), {"metal": 2}, lambda _: "Saved")
    viewer = Viewer(
        lambda: seen, photographs(seen), shading=seen.shading, host=host, port=18431, save=lambda _: "",
        paintable=paintable,
    )  # fmt: skip
    try:
        assert bool(viewer._options.kinds) == paints
    finally:
        viewer.close()
