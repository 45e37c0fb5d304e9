"""The PLY module: the release's layout to the byte, round trips, colors refitted for ordinary viewers."""

import re
import struct

import pytest
import torch
from faults import Fault
from plyfile import PlyData

from polarguide.gaussians.ply import read_ply, refit_sh, write_ply
from polarguide.geometry.vectors import spread_directions

COUNT = 7
SHAPES = {
    "means": (3,),
    "log_scales": (3,),
    "quaternions": (4,),
    "opacity_logits": (),
    "sh_dc": (1, 3),
    "sh_rest": (15, 3),
}


def rand(seed, *shape):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def gaussians(count=COUNT):
    return {name: rand(seed, count, *shape) for seed, (name, shape) in enumerate(SHAPES.items())}


def header_of(path):
    data = path.read_bytes()
    end = data.index(b"end_header\n") + len(b"end_header\n")
    return data[:end].decode("ascii"), data[end:]


def test_without_extras_the_file_is_the_releases_to_the_byte(tmp_path):
    rows = gaussians()
    write_ply(tmp_path / "p.ply", **rows)
    header, body = header_of(tmp_path / "p.ply")
    fields = (
        ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
        + [f"f_rest_{i}" for i in range(45)]
        + ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    )
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {COUNT}"]
    assert header == "\n".join([*lines, *(f"property float {name}" for name in fields), "end_header", ""])
    assert len(body) == COUNT * 62 * 4
    record = struct.unpack_from("<62f", body, 3 * 62 * 4)
    expected = [
        *rows["means"][3].tolist(),
        *(0.0, 0.0, 0.0),
        *rows["sh_dc"][3, 0].tolist(),
        *rows["sh_rest"][3, :, 0].tolist(),  # all of red, then green, then blue
        *rows["sh_rest"][3, :, 1].tolist(),
        *rows["sh_rest"][3, :, 2].tolist(),
        rows["opacity_logits"][3].item(),
        *rows["log_scales"][3].tolist(),
        *rows["quaternions"][3].tolist(),
    ]
    assert list(record) == expected


def test_round_trip_with_extras(tmp_path):
    rows = gaussians()
    extra = {
        "linear_dc": rand(10, COUNT, 1, 3),
        "linear_rest": rand(11, COUNT, 15, 3),
        "strength": rand(12, COUNT),
        "local": rand(13, COUNT, 5),
        "deep": rand(14, COUNT, 2, 3, 4),
    }
    path = tmp_path / "p.ply"
    write_ply(path, **rows, extra=extra)
    read = read_ply(path)
    assert {k for k in read if k != "extra"} == set(rows)
    for name, tensor in rows.items():
        assert torch.equal(read[name], tensor), name
    assert list(read["extra"]) == list(extra)
    for name, tensor in extra.items():
        assert torch.equal(read["extra"][name], tensor), name
    header, _ = header_of(path)
    assert header.splitlines()[2] == f"element vertex {COUNT}"
    names = re.findall(r"property float (\w+)", header)
    assert names[62:66] == ["linear_dc_0", "linear_dc_1", "linear_dc_2", "linear_rest_0"]
    vertex = PlyData.read(path)["vertex"]
    assert vertex["linear_rest_16"][2] == extra["linear_rest"][2, 1, 1].item()  # channel-major, as f_rest
    assert [p.name for p in tmp_path.iterdir()] == ["p.ply"]


def test_opacity_column_and_other_precision(tmp_path):
    rows = gaussians()
    rows["opacity_logits"] = rows["opacity_logits"][:, None]
    write_ply(tmp_path / "p.ply", **{k: v.double() for k, v in rows.items()})
    assert torch.equal(read_ply(tmp_path / "p.ply")["opacity_logits"], rows["opacity_logits"][:, 0])


def test_no_gaussians(tmp_path):
    write_ply(tmp_path / "p.ply", **gaussians(0), extra={"strength": torch.zeros(0)})
    read = read_ply(tmp_path / "p.ply")
    assert read["sh_rest"].shape == (0, 15, 3)
    assert read["extra"]["strength"].shape == (0,)


@pytest.mark.parametrize(("rest", "coefficients"), [(0, 0), (9, 3), (24, 8)])
def test_reads_files_of_lower_degree_and_unknown_fields(tmp_path, rest, coefficients):
    names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", *(f"f_rest_{i}" for i in range(rest)), "opacity"]
    names += ["scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3", "quality"]
    header = [
        "ply",
        "format ascii 1.0",
        "element vertex 1",
        *(f"property float {n}" for n in names),
        "end_header",
    ]
    path = tmp_path / "p.ply"
    path.write_text("\n".join([*header, " ".join(str(i) for i in range(len(names))), ""]))
    read = read_ply(path)
    assert read["sh_rest"].shape == (1, coefficients, 3)
    if rest:
        assert read["sh_rest"][0, 1].tolist() == [7, 7 + coefficients, 7 + 2 * coefficients]
    assert read["extra"]["quality"].tolist() == [len(names) - 1]


@pytest.mark.parametrize(
    ("old", "new", "expected", "found"),
    [
        (b"property float rot_3\n", b"property float rot_x\n", "", "no rot_3"),
        (b"f_rest_44", b"f_more_44", "", "44 fields f_rest_"),
        (b"element vertex", b"element corner", "a vertex element", ""),
        (b"comment extra strength", b"comment extra strength 3", "strength", ""),
        (b"property float x\n", b"property list uchar float x\n", "a PLY file", ""),
        (None, -1, "a PLY file", ""),
        (None, b"a picture, perhaps\n", "a PLY file", ""),
        (None, b"\xff\xfe\x00\n\x81", "a PLY file", ""),
        (None, b"", "a PLY file", ""),
        (None, None, "a PLY file", "no file"),
    ],
)
def test_unreadable_files_are_named(tmp_path, old, new, expected, found):
    """Something of the file is another, or the whole file is, or it is cut, or there is none."""
    path = tmp_path / "p.ply"
    write_ply(path, **gaussians(), extra={"strength": rand(1, COUNT)})
    whole = path.read_bytes()
    path.unlink()
    if old:
        path.write_bytes(whole.replace(old, new))
    elif new is not None:
        path.write_bytes(whole[:new] if new == -1 else new)
    Fault(str(path), expected, found).raised_by(read_ply, path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"sh_rest": torch.zeros(COUNT, 8, 3)}, r"sh_rest: .*\[7, 15, 3\].*\[7, 8, 3\]"),
        ({"opacity_logits": torch.zeros(COUNT + 1)}, r"opacity_logits: .*\[7\]"),
        ({"extra": {"strength": torch.zeros(3)}}, r"'strength': .*\[7, ...\].*\[3\]"),
        ({"extra": {"two words": torch.zeros(COUNT)}}, "'two words'"),
        ({"extra": {"opacity": torch.zeros(COUNT)}}, "opacity"),
        ({"extra": {"label": torch.zeros(COUNT, dtype=torch.long)}}, "label"),
    ],
)
def test_what_does_not_fit_is_refused(tmp_path, change, message):
    with pytest.raises(ValueError, match=message):
        write_ply(tmp_path / "p.ply", **{**gaussians(), **change})
    assert not list(tmp_path.iterdir())


def release_color(dc, rest, directions):
    """The color a 3DGS viewer shows, from the real spherical harmonics written out in full: [N, K, 3]."""
    x, y, z = directions.double().unbind(-1)
    terms = [0.28209479177387814 * torch.ones_like(x)]
    terms += [-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x]
    terms += [1.0925484305920792 * x * y, -1.0925484305920792 * y * z, 0.31539156525252005 * (3 * z**2 - 1)]
    terms += [-1.0925484305920792 * x * z, 0.5462742152960396 * (x**2 - y**2)]
    terms += [-0.5900435899266435 * (3 * x**2 * y - y**3), 2.890611442640554 * x * y * z]
    terms += [-0.4570457994644658 * y * (5 * z**2 - 1), 0.3731763325901154 * (5 * z**3 - 3 * z)]
    terms += [-0.4570457994644658 * x * (5 * z**2 - 1), 1.445305721320277 * z * (x**2 - y**2)]
    terms += [-0.5900435899266435 * (x**3 - 3 * x * y**2)]
    basis = torch.stack(terms, -1)
    return 0.5 + torch.einsum("kd,ndc->nkc", basis, torch.cat((dc, rest), 1).double())


UP = torch.tensor([[0.0, 0.0, 1.0]])


def test_refit_reproduces_harmonics(monkeypatch):
    """Whatever the weights are, and however many Gaussians are fitted at a time."""
    monkeypatch.setattr("polarguide.gaussians.ply.TOGETHER", 7)
    dc, rest = rand(1, 20, 1, 3) * 0.3, rand(2, 20, 15, 3) * 0.3
    normals = torch.nn.functional.normalize(rand(5, 20, 3), dim=-1)
    for slope in (None, lambda colors: 1 + colors.square()):
        found = refit_sh(lambda part, d: release_color(dc[part], rest[part], d), normals, slope)
        assert torch.allclose(found[0], dc, atol=1e-5)
        assert torch.allclose(found[1], rest, atol=1e-5)


def highlight(part, directions):
    """A narrow bright spot over a flat color, clipped to the display's range: [5, K, 3]."""
    axes = torch.nn.functional.normalize(rand(3, 5, 3), dim=-1)[part]
    spot = torch.exp(8 * (axes @ directions.T.to(axes) - 1))
    return (0.2 + 0.9 * spot[..., None] * torch.tensor([1.0, 0.8, 0.6])).clamp(0, 1)


def errors_of(slope, seen):
    """Of the fit to highlights on Gaussians in the plane z = 0, from directions with |z| in a range: shown values."""
    probe = torch.nn.functional.normalize(rand(4, 4000, 3), dim=-1)
    probe = probe[(probe[:, 2].abs() > seen[0]) & (probe[:, 2].abs() < seen[1])]
    true = highlight(slice(None), probe) ** 2.2
    dc, rest = refit_sh(lambda part, d: highlight(part, d) ** 2.2, UP.expand(5, 3), slope)
    found = release_color(dc, rest, probe).clamp(min=0)
    return float((found ** (1 / 2.2) - true ** (1 / 2.2)).square().mean().sqrt())


def test_refit_is_nearest_where_it_is_seen():
    assert errors_of(None, (0.5, 1.0)) < 0.75 * errors_of(None, (0.0, 0.2))


def test_slopes_make_the_shown_error_small():
    assert errors_of(lambda y: y ** (1 / 2.2 - 1), (0.0, 1.0)) < 0.9 * errors_of(None, (0.0, 1.0))


def test_refit_refuses_colors_of_another_shape():
    with pytest.raises(ValueError, match=r"colors: .*\[6, 64, 3\].*\[5, 64, 3\]"):
        refit_sh(highlight, UP.expand(6, 3))


def test_directions_are_spread_evenly():
    points = spread_directions(64)
    assert torch.allclose(points.norm(dim=-1), torch.ones(64, dtype=torch.float64))
    nearest = (points @ points.T - 2 * torch.eye(64, dtype=torch.float64)).amax(1).clamp(max=1).acos()
    assert nearest.min() > 0.7 * nearest.max()
