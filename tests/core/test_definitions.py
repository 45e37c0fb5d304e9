"""Digests of a user's definitions: they change with the code that counts, and with nothing else."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from polarguide.core.definitions import definition_digest

SCRIPT = """
from dataclasses import dataclass
import math
import helper
SCALE = 2.0
def inner(x):
    return SCALE * math.sqrt(x) + helper.offset(x)
def measure(target, layers):
    return inner(1.0) + helper.offset(1)
@dataclass
class Weights:
    smooth: float = 0.1
    def own_terms(self):
        return (measure,)
def unused():
    return 1
from polarguide.core.definitions import definition_digest
print(definition_digest(measure), definition_digest(Weights(0.2)))
"""
HELPER = "def offset(x):\n    return x\n"


def digests(folder: Path, script: str = SCRIPT, helper: str = HELPER) -> list[str]:
    (folder / "helper.py").write_text(helper)
    (folder / "script.py").write_text(script)
    done = subprocess.run(
        [sys.executable, "script.py"], cwd=folder, capture_output=True, text=True, check=True
    )
    return done.stdout.split()


def test_a_digest_follows_the_code_that_is_used(tmp_path: Path) -> None:
    before = digests(tmp_path)
    assert len(before[0]) == 16
    assert before[0] != before[1]
    assert digests(tmp_path, SCRIPT.replace("return 1\n", "return 3\n")) == before
    for old, new in (("SCALE = 2.0", "SCALE = 3.0"), ("math.sqrt(x)", "math.log(x)"), ("(1.0) +", "(4.0) +")):
        assert not set(digests(tmp_path, SCRIPT.replace(old, new))) & set(before)
    assert not set(digests(tmp_path, helper=HELPER.replace("return x", "return 2 * x"))) & set(before)
    first, second = digests(tmp_path, SCRIPT.replace("return (measure,)", "return (measure, measure)"))
    assert first == before[0]
    assert second != before[1]


VALUES = """
import abc, enum, functools, threading, types
import numpy as np
import torch
import own_package.helper
from dataclasses import dataclass, field
LIMITS = (1.0, {"low": [2.0]})
NAMES = {"a", "b", "c"}
MASK = torch.tensor([1.0, 3.0])
TENSORS = [torch.ones(2, dtype=torch.complex64).conj(), torch.eye(2).to_sparse(), torch.tensor(17.0), torch.zeros(0, 3)]
ARRAY = np.array([4, 5])
LOCK = threading.Lock()
class Kind(enum.Enum):
    FIRST = "first"
def inner(x, power=6.0):
    return x ** power
class Part(abc.ABC):
    SCALE = 7.0
    @staticmethod
    def fixed():
        return 8.0
    @property
    def size(self):
        return 9.0
    @functools.lru_cache
    def cached(self):
        return 10.0
@dataclass
class Weights:
    smooth: float = 11.0
    parts: list = field(default_factory=lambda: [12.0])
def decorated(function):
    @functools.wraps(function)
    def call(*arguments):
        return function(*arguments) * 13.0
    return call
@decorated
def outer(x):
    return x + 14.0
table = types.SimpleNamespace(value=15.0)
def measure(target, layers):
    def later():
        return never
    terms = [inner(x) + LIMITS[0] for x in target if x in {"p", "q", "r"}]
    terms += (own_package.helper.offset(1) for x in (lambda: MASK + ARRAY)())
    terms += [Part.SCALE, Weights, outer, table, LOCK, NAMES, TENSORS, Kind.FIRST, measure, later]
    return terms
    never = 0
made = {}
exec("def generated(x):\\n    return abs(x)", made)
definitions = (measure, functools.partial(inner, power=16.0), made["generated"])
"""
PRINT = """
from polarguide.core.definitions import definition_digest
print(definition_digest(*definitions))
"""


def digest_of(script: str) -> str:
    main: dict[str, Any] = {"__name__": "__main__"}
    exec(script, main)
    return definition_digest(*main["definitions"])


def test_a_digest_follows_values_and_nested_code(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "own_package"
    folder.mkdir()
    (folder / "helper.py").write_text(HELPER)
    monkeypatch.syspath_prepend(tmp_path)
    before = digest_of(VALUES)
    assert digests(tmp_path, f"# Another line number\n{VALUES}{PRINT}") == [before]
    changes = {f"{number}.0": "0.5" for number in (1, 2, 3, *range(6, 18))}
    changes |= {"[4, 5]": "[4, 6]", '"c"': '"d"', '"first"': '"second"', '"r"': '"s"', "abs(x)": "len(x)"}
    changed = {old: digest_of(VALUES.replace(old, new, 1)) for old, new in changes.items()}
    assert [old for old, digest in changed.items() if digest == before] == []
    assert len(set(changed.values())) == len(changes)
    (folder / "helper.py").write_text(HELPER.replace("return x", "return -x"))
    monkeypatch.delitem(sys.modules, "own_package")
    monkeypatch.delitem(sys.modules, "own_package.helper")
    assert digest_of(VALUES) != before
