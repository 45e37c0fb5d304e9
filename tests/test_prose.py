"""Language rules of CONTRIBUTING for docstrings, comments, messages and documentation pages.

Ruff checks the form of docstrings (imperative mood, one line of summary). These tests add the rules that no package
knows: how sentences start, how long they are, and which private terms are replaced.
"""

import ast
import io
import re
import statistics
import tokenize
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
SOURCES = sorted((ROOT / "src").rglob("*.py"))
KERNELS = sorted(path for suffix in ("*.cpp", "*.h") for path in (ROOT / "native").rglob(suffix))
TERMS_PAGE = ROOT / "docs/reference/writing.md"
PAGES = sorted(
    path
    for path in (ROOT / "docs").rglob("*.md")
    if "generated" not in path.parts and path != TERMS_PAGE  # it names the private terms
)
START = re.compile(r"(What|Whether|Whoever|Of)\b(?! course)")
MAXIMUM = 40
MEDIAN = 18


def private_terms():
    """Return the expressions in code style of the right column of ``docs/reference/writing.md``."""
    rows = TERMS_PAGE.read_text(encoding="utf-8").splitlines()
    columns = [row.split("|")[2] for row in rows if row.startswith("|") and "---" not in row]
    return [term for column in columns for term in re.findall(r"`([^`]+)`", column)]


TERM = re.compile(r"\b(" + "|".join(map(re.escape, private_terms())) + r")\b", re.IGNORECASE)


def plain(text):
    """Replace code, formulas, links and fields by one word each, and join the lines."""
    text = re.sub(
        r"\$\$.*?\$\$|``[^`]*``|:\w+:`[^`]*`|`[^`]*`|\$[^$]*\$|\]\([^)]*\)|\{[^}]*\}",
        " X ",
        text,
        flags=re.DOTALL,
    )
    return re.sub(r"\s+", " ", text).strip()


def sentences(text):
    """Split a text into sentences; blank lines, list items and named entries separate them, too."""
    for block in re.split(r"\n\s*\n|\n\s*(?=[\w ,*`]+: )|\n\s*(?:[-*]|\d+\.) ", f"\n{text}"):
        for sentence in re.split(r"(?<=[.!?;:])\s+(?=[A-Z0-9\"'(*])", plain(block)):
            if sentence:
                yield sentence


def strings(tree):
    """Yield line and text of each docstring, and of each literal of four words or more."""
    parts = set()
    documented = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.JoinedStr):
            parts.update(map(id, node.values))
            pieces = [value.value if isinstance(value, ast.Constant) else "X" for value in node.values]
            if " ".join(pieces).count(" ") >= 3:
                yield node.lineno, "".join(pieces)
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            documented.add(id(node.value))
    for node in ast.walk(tree):
        if not isinstance(node, ast.Constant) or not isinstance(node.value, str) or id(node) in parts:
            continue
        if id(node) in documented or node.value.count(" ") >= 3:
            yield node.lineno, node.value


def comments(text):
    """Yield line and text of each block of comments."""
    lines = {
        token.start[0]: token.string.lstrip("# ")
        for token in tokenize.generate_tokens(io.StringIO(text).readline)
        if token.type == tokenize.COMMENT
    }
    for line in lines:
        if line - 1 in lines:
            continue
        block = []
        while line + len(block) in lines:
            block.append(lines[line + len(block)])
        yield line, " ".join(block)


def kernel_comments(text):
    """Yield line and text of each ``//`` comment in C++; comments that fill lines form a block."""
    for match in re.finditer(r"(?:^[ \t]*//[^\n]*\n)+|//[^\n]*", text, re.MULTILINE):
        block = [line.strip().lstrip("/ ") for line in match[0].splitlines()]
        yield text.count("\n", 0, match.start()) + 1, " ".join(block)


def paragraphs(text):
    """Yield line and text of each paragraph, list item and table cell of a Markdown page, without code blocks."""
    text = re.sub(
        r"```.*?```|^---\n.*?\n---\n|<[^>]*>", lambda match: "\n" * match[0].count("\n"), text, flags=re.S
    )
    for number, block in ((m.start(), m[0]) for m in re.finditer(r"[^\n]+(?:\n[^\n]+)*", text)):
        line = text.count("\n", 0, number) + 1
        for cell in re.split(r"\s\|\s|\n\||^#+ ", block, flags=re.MULTILINE) if "|" in block else [block]:
            yield line, cell


def texts(path):
    """Return the texts of a file with their lines."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".py":
        return [*strings(ast.parse(text)), *comments(text)]
    if path.suffix == ".md":
        return list(paragraphs(text))
    return list(kernel_comments(text))


def findings(pairs):
    """Return the findings of (line, text) pairs, and the lengths of their sentences in words."""
    found = []
    lengths = []
    for line, text in pairs:
        for sentence in sentences(text):
            words = len(sentence.split())
            if words > 2:
                lengths.append(words)
            if START.match(sentence):
                found.append(f"{line}: starts with {sentence.split()[0]}: {sentence[:60]}")
            term = TERM.search(re.sub(r"\b[Nn]either\b.*?\bnor\b", "", sentence))
            if term and "None" not in term[0]:  # ``None`` of Python
                found.append(f"{line}: private term {term[0]!r}: {sentence[:60]}")
            if words > MAXIMUM:
                found.append(f"{line}: {words} words: {sentence[:60]}")
    return found, lengths


@pytest.mark.parametrize("paths", [SOURCES, KERNELS, PAGES], ids=["src", "native", "docs"])
def test_sentences_are_plain(paths):
    faults = []
    lengths = []
    for path in paths:
        found, words = findings(texts(path))
        faults += [f"{path.relative_to(ROOT)}:{fault}" for fault in found]
        lengths += words
    assert faults == []
    assert statistics.median(lengths) <= MEDIAN


@pytest.mark.parametrize(
    ("text", "count"),
    [
        ("What is seen counts. Of two views one wins.", 2),
        ("The color, if there are none.", 1),
        ("Return the mask. " + "word " * 41, 1),
        ("Return the mask; ``Of code`` and `What` are names.", 0),
        ("Args:\n    mask: pixels.\n    whether: Whether it is.", 1),
        ("It has neither depth nor color, nor light.", 1),
        ("- What a list starts with\n- Of items", 2),
    ],
)
def test_findings_of_a_text(text, count):
    assert len(findings([(1, text)])[0]) == count


def test_comments_and_strings_are_read_as_blocks():
    text = '"""Doc."""\n# one\n# two\nx = f"see {x} of the {y}"  # three\n'
    assert [pair[1] for pair in comments(text)] == ["one two", "three"] or list(comments(text)) == [
        (2, "one two three")
    ]
    assert list(strings(ast.parse(text))) == [(4, "see X of the X"), (1, "Doc.")]


def test_comments_of_kernels_are_read_as_blocks():
    assert list(kernel_comments("int a; // one\n// two\nint b;\n")) == [(1, "one"), (2, "two")]
    assert list(kernel_comments("// one\n  // two\nint a;\n")) == [(1, "one two")]
