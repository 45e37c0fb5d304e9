"""Digests of a user's definitions: they change with the code that counts, and with nothing else."""

import subprocess
import sys
from pathlib import Path

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
