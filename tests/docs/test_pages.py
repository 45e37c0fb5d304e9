"""What the documentation says about the program is so: names, files, options, citations, spelling."""

import ast
import inspect
import re
from pathlib import Path

import pytest

import polarguide
from polarguide.methods import RECIPES
from polarguide.results.evaluation.table import METRICS
from polarguide_bench.recipes import ABLATIONS
from polarguide_shots.measurement.table import FORMAT, KEYS

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
SOURCES = ROOT / "src"
PACKAGE = SOURCES / "polarguide"
GENERATED = (DOCS / "generated", DOCS / "reference" / "api")
PAGES = sorted(p for p in DOCS.rglob("*.md") if not any(made in p.parents for made in GENERATED))
BESIDE = ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "research/trials.md", "research/unknown.md")
TEXTS = [*PAGES, *(ROOT / name for name in BESIDE)]

FENCE = re.compile(r"^```(\w*)[^\n]*\n(.*?)^```", re.MULTILINE | re.DOTALL)
# Folders of the repository whose files the pages name.
NAMED_FILE = re.compile(r"\b(?:benchmarks|examples|native|src|tests)/[\w./-]+\.(?:py|json|cpp|h)\b")
MODULE_FILE = re.compile(r"`([a-z_]+(?:/[a-z_]+)+\.py)`")
# Options of other programs that pages show, too.
FOREIGN_OPTIONS = {
    *(
        "torch-backend",
        "nproc-per-node",
        "no-python",
        "no-register",
        "no-align",
        "help",
        "version",
        "python",
        "large",
        "tiny",
        "picture",
        "opensplat",
        "gaussians",
        "port",
        "dashboard-address",
        "nthreads",
        "gres",
        "me",
        "tag",
        "rm",
        "volume",
        "user",
        "load-depths",
        "normal-format",
        "normal-loss-weight",
        "pipeline",
    ),
}
BRITISH = re.compile(
    r"\b\w*(?:colour|grey\b|centre|neighbour|behaviour|licence|analyse|catalogue|metre\b|harbour|"
    r"(?:rasteri|normali|initiali|optimi|organi|recogni|quanti|minimi|maximi|synchroni|digiti|summari)s(?:e|ing|ation))\w*",
    re.IGNORECASE,
)


def text_of(path):
    return path.read_text(encoding="utf-8")


def python_blocks():
    for path in TEXTS:
        for number, (language, code) in enumerate(FENCE.findall(text_of(path))):
            if language == "python":
                yield pytest.param(code, id=f"{path.relative_to(ROOT)}-{number}")


def test_there_are_pages():
    assert len(PAGES) > 30


@pytest.mark.parametrize("path", TEXTS, ids=lambda p: str(p.relative_to(ROOT)))
def test_files_and_links_exist(path):
    text = text_of(path)
    missing = [name for name in NAMED_FILE.findall(text) if "<" not in name and not (ROOT / name).exists()]
    missing += [
        name
        for name in MODULE_FILE.findall(text)
        if not any((at / name).exists() for at in (PACKAGE, SOURCES, ROOT))
    ]
    for target in re.findall(r"\]\(([^)\s]+)\)", FENCE.sub("", text)):
        file, _, anchor = target.partition("#")
        if "://" in target:
            continue
        found = path.parent / file if file else path
        if any(made in found.resolve().parents for made in GENERATED):
            continue
        if not found.exists() or (anchor and anchor not in anchors(text_of(found))):
            missing.append(target)
    served = re.findall(r'(?:href|src)="([^"#:]+)"', text)
    assert missing + [name for name in served if not (DOCS / name).exists()] == []


def anchors(text):
    """The anchors of a page's headings, as GitHub and MyST make them."""
    headings = re.findall(r"^#+ (.+)$", FENCE.sub("", text), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", h.lower().replace("`", "")).replace(" ", "-") for h in headings}


@pytest.mark.parametrize("path", TEXTS, ids=lambda p: str(p.relative_to(ROOT)))
def test_pictures_say_what_they_show(path):
    text = text_of(path)
    blocks = re.findall(r"^```\{(?:image|figure|code-cell)\}.*?^```", text, re.MULTILINE | re.DOTALL)
    pictured = [
        block
        for block in blocks
        if re.search(r"\{(?:image|figure)\}|^show\(|^figure, axes", block, re.MULTILINE)
    ]
    assert re.findall(r"!\[\s*\]\([^)]+\)", text) == []
    assert re.findall(r'<img(?![^>]* alt="[^"]+)[^>]*>', text) == []
    assert [block for block in pictured if not re.search(r"alt: \S", block)] == []
    for drawing in re.findall(r":file: (\S+\.svg)", text):
        assert "aria-label=" in text_of(path.parent / drawing)


@pytest.mark.parametrize("code", list(python_blocks()))
def test_python_compiles(code):
    ast.parse(code)


def called(node):
    """The public function or method that a call in an example reaches: ``pg.NAME(...)`` or ``run.NAME(...)``."""
    place = node.func
    if isinstance(place, ast.Attribute) and isinstance(place.value, ast.Name):
        return {"pg": polarguide, "run": polarguide.Run}.get(place.value.id), place.attr
    return None, ""


def test_calls_in_examples_fit():
    fitted = 0
    for code in python_blocks():
        for node in ast.walk(ast.parse(code.values[0])):
            owner, name = called(node) if isinstance(node, ast.Call) else (None, "")
            if owner is not None:
                itself = [None] if owner is polarguide.Run else []
                given = {keyword.arg: None for keyword in node.keywords}
                inspect.signature(getattr(owner, name)).bind(*itself, *node.args, **given)
                fitted += 1
    assert fitted > 20


def test_every_metric_is_defined():
    page = text_of(DOCS / "reference" / "metrics.md")
    assert [metric.key for metric in METRICS if f"`{metric.key}`" not in page] == []


def test_every_recipe_is_described_and_every_named_one_exists():
    page = "".join(text_of(DOCS / "explanation" / name) for name in ("recipes.md", "baselines.md"))
    assert [name for name in RECIPES if f"## `{name}`" not in page] == []
    known = {*RECIPES, *(recipe.name for recipes in ABLATIONS.values() for recipe in recipes)}
    bases = "|".join(map(re.escape, RECIPES))
    named = {n for path in TEXTS for n in re.findall(rf"`((?:{bases}):[a-z-]+)`", text_of(path))}
    assert named
    assert named - known == set()


def parameters():
    """Names of parameters and fields that an option can stand for: of verbs, and of the dataclasses that they read."""
    for path in SOURCES.rglob("*.py"):
        for node in ast.walk(ast.parse(text_of(path))):
            if isinstance(node, ast.arg):
                yield node.arg
            elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
                yield node.target.id


def test_options_exist():
    words = set(parameters())
    unknown = {}
    for path in TEXTS:
        if path.name == "CHANGELOG.md":  # it names options that are no more
            continue
        for option in re.findall(r"(?<![\w-])--([a-z][a-z-]+)", text_of(path)):
            named = option.removeprefix("no-").replace("-", "_")
            if option not in FOREIGN_OPTIONS and named not in words:
                unknown.setdefault(option, path.name)
    assert unknown == {}


def test_the_bibliography_holds_what_is_cited():
    bibliography = text_of(DOCS / "reference" / "bibliography.bib")
    authors = {name.lower() for name in re.findall(r"author = \{([^,{]+)", bibliography)}
    folders = (SOURCES, ROOT / "benchmarks")
    sources = "\n".join(text_of(p) for folder in folders for p in folder.rglob("*.py"))
    name = "[A-Z][a-z]+"
    cited = set(re.findall(rf"\b({name})(?:, {name})*(?: et al\.|,? and {name})? (?:19|20)\d\d\b", sources))
    assert cited
    assert {name for name in cited if name.lower() not in authors} == set()
    keys = re.findall(r"^@\w+\{(\w+),", bibliography, re.MULTILINE)
    assert len(set(keys)) == len(keys) > 20


@pytest.mark.parametrize("path", TEXTS, ids=lambda p: str(p.relative_to(ROOT)))
def test_american_spelling(path):
    # Names that stay (an ablation's) and old names (in the changelog) are code.
    assert BRITISH.findall(re.sub(r"`[^`\n]*`", "", text_of(path))) == []


def test_pages_that_messages_name_exist() -> None:
    named = {
        name
        for path in sorted((ROOT / "src").rglob("*.py"))
        for name in re.findall(r"docs/[\w/-]+\.md", path.read_text(encoding="utf-8"))
    }
    assert named
    assert {name for name in named if not (ROOT / name).is_file()} == set()


def test_every_field_of_the_table_of_measure_is_explained():
    section = (
        text_of(DOCS / "reference" / "formats.md")
        .partition("## The table of `measure`")[2]
        .partition("\n## ")[0]
    )
    assert f"format {FORMAT} " in section
    rows = [line for line in section.splitlines() if line.startswith("| `")]
    assert [key for row in rows for key in re.findall(r"`(\w+)`", row.split("|")[1])] == list(KEYS)


def words(text):
    """The words of a page: what has a letter or a digit, without formulas."""
    plain = re.sub(r"\$\$.*?\$\$|\$[^$]*\$", "", text, flags=re.DOTALL)
    return sum(any(c.isalnum() for c in word) for word in plain.split())


def test_pages_are_short():
    counts = {page: words(text_of(page)) for page in PAGES if DOCS / "reference" not in page.parents}
    limits = {DOCS / "explanation" / "method.md": 2500}
    assert {page: count for page, count in counts.items() if count > limits.get(page, 1800)} == {}
    assert sum(counts.values()) <= 45_000


@pytest.mark.parametrize(
    "path", sorted({*(DOCS / "how-to").glob("*.md")} - {DOCS / "how-to" / "index.md"}), ids=lambda p: p.stem
)
def test_a_guide_begins_with_what_to_type(path):
    assert text_of(path).split("\n\n")[1].startswith("```")
