"""What nobody specified of a training is decided in one place: no other has a number of its own to fall back on."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

import polarguide

SOURCES = Path(polarguide.__file__).parent
SETTINGS = {"refractive_index", "background", "steps", "gaussians", "memory"}
CONSTANTS = {"INDEX", "STEPS"}
DECIDES = {"options.py", "runs/folder.py", "training/settings.py"}
EXCEPT = {
    ("optics", "default of refractive_index"): "formulas, which know no scene",
    ("shading/model.py", "default of refractive_index"): "of a recipe; ``bind`` gives it the run's",
    ("cli/runs.py", "default of steps"): "the demo's own number",
    ("inspection/settings.py", "default of steps"): "of the short training that inspects",
    ("fields/recipe.py", "default of steps"): "the recipe's own number, which ``resolve`` takes",
    ("fields/recipe.py", "default of background"): "samples of a ray",
    ("experiments/record.py", "refractive_index compared with 0"): "records of the first versions",
}


def setting(node: ast.expr) -> str | None:
    """The setting that an expression reads: a name, an attribute, or a key."""
    match node:
        case ast.Name(id=name) | ast.Attribute(attr=name):
            pass
        case ast.Subscript(slice=ast.Constant(value=str(name))):
            pass
        case ast.Call(func=ast.Attribute(attr="get"), args=[ast.Constant(value=str(name)), *_]):
            pass
        case ast.NamedExpr(value=value):
            return setting(value)
        case _:
            return None
    return name if name in SETTINGS else None


def defaults(node: ast.FunctionDef) -> Iterator[tuple[str, ast.expr]]:
    given = node.args
    places = [*given.posonlyargs, *given.args]
    yield from zip([a.arg for a in places[len(places) - len(given.defaults) :]], given.defaults, strict=True)
    yield from ((a.arg, d) for a, d in zip(given.kwonlyargs, given.kw_defaults, strict=True) if d is not None)


def number(node: ast.expr) -> bool:
    """Whether an expression is a number or one of our constants, by itself or as the default of a field."""
    match node:
        case ast.Constant(value=int() | float()) | ast.Name(id="INDEX" | "STEPS"):
            return True
        case ast.Call(keywords=[ast.keyword(arg="default", value=value), *_]):
            return number(value)
    return False


def fallbacks(node: ast.AST) -> Iterator[str]:
    """What a piece of code has in place of a setting that is not specified."""
    match node:
        case ast.BoolOp(op=ast.Or(), values=[first, *_]) if name := setting(first):
            yield f"{name} or"
        case ast.IfExp(test=ast.Compare(left=left, comparators=[ast.Constant(value=None)])) if (
            name := setting(left)
        ):
            if name in (setting(node.body), setting(node.orelse)):
                yield f"{name} if it is given"
        case ast.IfExp(test=test) | ast.If(test=test) if name := setting(
            test.operand if isinstance(test, ast.UnaryOp) else test
        ):
            yield f"{name} as true or false"
        case ast.Compare(left=left, comparators=[ast.Constant(value=value)]) if value == 0 and (
            name := setting(left)
        ):
            yield f"{name} compared with 0"
        case ast.Call(args=[_, other]) if (name := setting(node)) and number(other):
            yield f"{name} of a record, or a number"
        case ast.FunctionDef():
            yield from (
                f"default of {name}" for name, value in defaults(node) if name in SETTINGS and number(value)
            )
        case ast.AnnAssign(target=ast.Name(id=name), value=ast.expr() as value) if (
            name in SETTINGS and number(value)
        ):
            yield f"default of {name}"
        case ast.ImportFrom(module="polarguide.core.options" | "polarguide.training.settings", names=names):
            yield from (f"{alias.name} taken" for alias in names if alias.name in CONSTANTS)


def found_in(source: str) -> list[str]:
    return [found for node in ast.walk(ast.parse(source)) for found in fallbacks(node)]


def test_only_one_place_falls_back_on_a_number() -> None:
    found = []
    for path in sorted(SOURCES.rglob("*.py")):
        place = path.relative_to(SOURCES).as_posix()
        if place in DECIDES:
            continue
        allowed = {what for (where, what) in EXCEPT if place == where or place.startswith(f"{where}/")}
        found += [f"{place}: {what}" for what in found_in(path.read_text("utf-8")) if what not in allowed]
    assert found == []


@pytest.mark.parametrize(
    "source",
    [
        "steps = settings.steps or 5000",
        "index = asked if refractive_index is None else refractive_index",
        "steps = STEPS if self.settings.steps is None else self.settings.steps",
        "n = record.get('refractive_index', 1.5)",
        "if not settings.steps: pass",
        "limited = options.memory > 0",
        "def train(*, steps: int = 1): pass",
        "def train(scene, refractive_index=1.5): pass",
        "class A:\n    memory: float = 0.0",
        "class A:\n    refractive_index: float = field(default=1.5)",
        "from polarguide.training.settings import STEPS",
    ],
)
def test_it_finds_what_it_is_there_for(source: str) -> None:
    assert len(found_in(source)) == 1


@pytest.mark.parametrize(
    "source",
    [
        "if settings.refractive_index is None: say('as scene.json says')",
        "text = '' if row.gaussians is None else f'{row.gaussians}'",
        "def train(*, refractive_index: float | None = None): pass",
        "bench = TrainSettings(steps=2500, refractive_index=1.5)",
    ],
)
def test_it_leaves_the_rest_alone(source: str) -> None:
    assert found_in(source) == []
