"""Data flows one way: every module imports only from rooms above its own, and openly."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = "polarguide"
FOLDERS = ("src", "benchmarks", "examples", "tests")
SOURCE = Path(__file__).resolve().parents[1] / "src"

# The packages, and which others each of them may import.
PACKAGES = {
    "polarguide": (),
    "polarguide_shots": ("polarguide",),
    "polarguide_synth": ("polarguide",),
    "polarguide_bench": ("polarguide", "polarguide_synth"),
}

# From the top down. A room may import from itself and from every room before it. A folder in a room may have a place of
# its own, named with the room's.
ROOMS = (
    "polarguide.core",
    "polarguide.geometry",
    "polarguide._native",
    "polarguide.optics",
    "polarguide.capture",
    "polarguide.preparation",
    "polarguide.gaussians",
    "polarguide.raster",
    "polarguide.shading",
    "polarguide.visualization",
    "polarguide.training",
    "polarguide.training.angles",
    "polarguide.methods",
    "polarguide.runs",
    "polarguide.results.rendering",
    "polarguide.results.evaluation",
    "polarguide.results.export",
    "polarguide.inspection",
    "polarguide.viewer",
    "polarguide.api",
    "polarguide.cli",
    "polarguide.__main__",
    "polarguide_shots.calibration",
    "polarguide_shots",
    "polarguide_shots.measurement",
    "polarguide_shots.api",
    "polarguide_shots.verbs",
    "polarguide_synth",
    "polarguide_synth.verbs",
    "polarguide_bench.datasets",
    "polarguide_bench.gnerp",
    "polarguide_bench",
    "polarguide_bench.verbs",
)
# What ``polarguide/__init__.py`` defines itself (its version) is for everyone. It names what others define for type
# checkers, and loads it by name when it is asked for.
ROOT = "polarguide"


def room_of(parts):
    """The room of a module's path, ROOT for the package itself: the longest name of a room that it begins with."""
    parts = [part for part in parts if part != "__init__"]
    names = [".".join(parts[:count]) for count in (3, 2, 1) if count <= len(parts)]
    return next((name for name in names if name in ROOMS), ".".join(parts[:2]))


def imported_rooms(node, parts):
    """The rooms that one import statement of the module at ``parts`` reaches; [] where it is not ours."""
    if isinstance(node, ast.Import):
        names = [alias.name.split(".") for alias in node.names]
        return [room_of(name) for name in names if name[0] in PACKAGES]
    if node.level:
        path = list(parts[: len(parts) - node.level]) + (node.module.split(".") if node.module else [])
    else:
        path = (node.module or "").split(".")
    if not path or path[0] not in PACKAGES:
        return []
    # What is imported may be a room, or something that the module itself defines.
    within = {room for room in ROOMS if room.startswith(".".join(path) + ".")}
    found = {room_of([*path, alias.name]) for alias in node.names}
    return sorted(room if room in within or path != [PACKAGE] else ROOT for room in found)


def imports(node, deferred=False, typing=False):
    """Import statements below a node: each, whether a function has it, and whether it is for type checkers alone."""
    deferred |= isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef))
    typing |= isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
    for inner in ast.iter_child_nodes(node):
        if isinstance(inner, (ast.Import, ast.ImportFrom)):
            yield inner, deferred, typing
        elif not isinstance(inner, ast.expr):  # expressions have no statements in them
            yield from imports(inner, deferred, typing)


def faults(source):
    """What breaks the order in the packages at ``source``, one line each."""
    found = []
    for path in sorted(source.rglob("*.py")):
        parts = path.relative_to(source).with_suffix("").parts
        room = room_of(parts)
        where = path.relative_to(source).as_posix()
        gathers = parts[2:] == ("__init__",) and any(each.startswith(f"{room}.") for each in ROOMS)
        if room != ROOT and room not in ROOMS and not gathers:
            found.append(f"{where}: the room {room} has no place in the order")
            continue
        tree = ast.parse(path.read_text(encoding="utf-8"), str(path))
        for node, deferred, typing in imports(tree):
            line = f"{where}:{node.lineno}"
            if any(alias.name == "*" for alias in node.names):
                found.append(f"{line}: star import")
            targets = imported_rooms(node, parts)
            if room == ROOT and typing:
                continue
            if targets and deferred:
                found.append(f"{line}: project import inside a function")
            for target in targets:
                package = target.partition(".")[0]
                if target in (ROOT, room):
                    continue
                if package not in (parts[0], *PACKAGES[parts[0]]):
                    found.append(f"{line}: {parts[0]} imports {package}, which it may not")
                elif target not in ROOMS:
                    found.append(f"{line}: imports {target}, which has no place in the order")
                elif room == ROOT or ROOMS.index(target) > ROOMS.index(room):
                    found.append(f"{line}: {room} imports {target}, which is further down")
    return found


def test_the_package_keeps_its_order():
    assert len(list(SOURCE.rglob("*.py"))) > 10
    assert faults(SOURCE) == []


def test_the_package_itself_imports_nothing_heavy():
    code = (
        "import sys, polarguide; dir(polarguide); polarguide.TrainSettings; "
        "print('torch' in sys.modules, callable(polarguide.compare), 'torch' in sys.modules); "
        "print('distributed' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False", "True", "True", "False"]


def clients_of_the_command_line(root):
    """Files that import ``polarguide.cli`` and are no part of it, below the folders of a checkout.

    Scripts in ``benchmarks`` may import its console, which prints messages and progress.
    """
    verbs = ("src/polarguide_shots/verbs", "src/polarguide_synth/verbs", "src/polarguide_bench/verbs")
    allowed = ("src/polarguide/cli/", "src/polarguide/__main__.py", *verbs, "tests/cli/", "tests/robustness/")
    found = []
    for path in sorted(p for folder in FOLDERS for p in (root / folder).rglob("*.py")):
        if path == Path(__file__).resolve():  # it names all rooms
            continue
        name, text = path.relative_to(root).as_posix(), path.read_text(encoding="utf-8")
        if "cli" not in text:  # most, and parsing them takes long
            continue
        tree = ast.parse(text, name)
        modules = {alias.name for n in ast.walk(tree) if isinstance(n, ast.Import) for alias in n.names}
        for node in (n for n in ast.walk(tree) if isinstance(n, ast.ImportFrom)):
            module = ("polarguide." if node.level else "") + (node.module or "")
            modules |= {f"{module}.{alias.name}" for alias in node.names}
        # A module may also be loaded by its name.
        modules |= {
            n.value for n in ast.walk(tree) if isinstance(n, ast.Constant) and isinstance(n.value, str)
        }
        modules = {m for m in modules if f"{m}.".startswith(f"{PACKAGE}.cli.")}
        if name.startswith("benchmarks/"):
            modules = {m for m in modules if not f"{m}.".startswith(f"{PACKAGE}.cli.console.")}
        if modules and not name.startswith(allowed):
            found.append(name)
    return sorted(found)


def test_nothing_but_itself_imports_the_command_line():
    assert clients_of_the_command_line(SOURCE.parent) == []


@pytest.mark.parametrize(
    "text",
    [
        "from polarguide.cli.app import run",
        "from polarguide import cli",
        "import polarguide.cli.app as app",
        "import importlib\nimportlib.import_module('polarguide.cli.app')",
    ],
)
def test_a_client_of_the_command_line_is_found(package, text):
    files = {"src/polarguide/runs/a.py": text, "benchmarks/b.py": text, "tests/cli/c.py": text}
    root = package({**files, "examples/d.py": "import polarguide"})
    assert clients_of_the_command_line(root) == ["benchmarks/b.py", "src/polarguide/runs/a.py"]


@pytest.fixture
def package(tmp_path):
    def write(files):
        for name, text in files.items():
            path = tmp_path / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)
        return tmp_path

    return write


def test_upward_and_outside_imports_are_fine(package):
    cli = [
        "import polarguide",
        "from polarguide import __version__, _native",
        "from ..optics.stokes import s",
    ]
    stokes = ["def f():", "    import scipy", "from ..core.errors import E", "from . import frames"]
    frames = [
        "import torch",
        "from polarguide.geometry.camera import Camera",
        "import polarguide.optics.stokes",
    ]
    source = package(
        {
            "polarguide/__init__.py": "__version__ = '1'",
            "polarguide/cli/runs.py": "\n".join(cli),
            "polarguide/optics/stokes.py": "\n".join(stokes),
            "polarguide/optics/frames.py": "\n".join(frames),
        }
    )
    assert faults(source) == []


@pytest.mark.parametrize(
    ("name", "text", "fault"),
    [
        (
            "__init__.py",
            "from polarguide.api import load",
            ":1: polarguide imports polarguide.api, which is further",
        ),
        (
            "optics/a.py",
            "from polarguide.training import loop",
            ":1: polarguide.optics imports polarguide.training",
        ),
        (
            "optics/a.py",
            "from polarguide import cli",
            ":1: polarguide.optics imports polarguide.cli, which is further",
        ),
        (
            "optics/a.py",
            "import polarguide.raster.cpu as c",
            ":1: polarguide.optics imports polarguide.raster",
        ),
        (
            "optics/a.py",
            "from ..raster import x",
            ":1: polarguide.optics imports polarguide.raster, which is further",
        ),
        (
            "optics/__init__.py",
            "from .. import raster",
            ":1: polarguide.optics imports polarguide.raster, which is",
        ),
        (
            "core/a.py",
            "from ..optics import x",
            ":1: polarguide.core imports polarguide.optics, which is further",
        ),
        (
            "results/export/a.py",
            "from polarguide.viewer import x",
            ":1: polarguide.results.export imports polarguide.",
        ),
        (
            "results/rendering/a.py",
            "from polarguide.results import export",
            ":1: polarguide.results.rendering imports",
        ),
        (
            "__init__.py",
            "from .core.errors import E",
            ":1: polarguide imports polarguide.core, which is further",
        ),
        ("cli/a.py", "def f():\n    from polarguide.optics import x", ":2: project import inside a function"),
        ("cli/a.py", "class A:\n  def f(self):\n    from . import b", ":3: project import inside a function"),
        ("cli/a.py", "from math import *", ":1: star import"),
        (
            "cli/a.py",
            "from polarguide.nowhere import x",
            ":1: imports polarguide.nowhere, which has no place",
        ),
        ("attic/a.py", "", ": the room polarguide.attic has no place in the order"),
        (
            "optics/a.py",
            "if TYPE_CHECKING:\n    from ..cli import x",
            ":2: polarguide.optics imports polarguide.cli",
        ),
        (
            "cli/a.py",
            "from polarguide_shots.read import x",
            ":1: polarguide imports polarguide_shots, which",
        ),
        (
            "viewer/a.py",
            "import polarguide_bench",
            ":1: polarguide imports polarguide_bench, which it may not",
        ),
    ],
)
def test_what_breaks_the_order_is_found(package, name, text, fault):
    found = faults(package({f"polarguide/{name}": text + "\n"}))
    assert len(found) == 1
    assert found[0].startswith(f"polarguide/{name}{fault}")


@pytest.mark.parametrize(
    ("name", "imported", "allowed"),
    [
        ("polarguide_shots/a.py", "polarguide.raster.cpu", True),
        ("polarguide_shots/a.py", "polarguide_bench.plan", False),
        ("polarguide_synth/a.py", "polarguide_shots.read", False),
        ("polarguide_bench/a.py", "polarguide_synth.render", True),
        ("polarguide_bench/a.py", "polarguide_shots.read", False),
        ("polarguide_bench/gnerp/a.py", "polarguide_bench.plan", False),
        ("polarguide_bench/a.py", "polarguide_bench.gnerp.runs", True),
    ],
)
def test_neighbors_import_the_product_and_the_bench_imports_synth(package, name, imported, allowed):
    assert (faults(package({name: f"from {imported} import x\n"})) == []) is allowed
