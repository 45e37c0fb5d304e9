"""Preparations that end in a message."""

from __future__ import annotations

import re
from pathlib import Path

from faults import Fault

from polarguide.capture import load_scene
from polarguide.preparation.prepare import prepare_scene
from polarguide.preparation.settings import PrepareSettings

MOSAIC = PrepareSettings(sensor="IMX250MYR", poses="none")
ANYTHING = Fault()
NAMES = ("v000", "v001", "v002")
FILTER = PrepareSettings(poses="none", align=False)


def refused(source: Path, out: Path, settings: PrepareSettings, fault: Fault = ANYTHING) -> str:
    """The message of a refusal, after which there is no scene that could be trained on."""
    text = str(fault.raised_by(prepare_scene, source, out, settings))
    assert not (out / "scene.json").exists()
    assert not (out / "sparse").exists()
    if (out / "polar").exists():
        ANYTHING.raised_by(load_scene, out)
    assert text.endswith(".")
    return text


def refused_in_one_line(source: Path, out: Path, settings: PrepareSettings, fault: Fault = ANYTHING) -> str:
    """The message of a refusal, which is one line with all of its parts."""
    text = refused(source, out, settings, fault)
    assert re.fullmatch(r"[^\n]+: expected [^\n]+, found [^\n]+\. [^\n]+", text), text
    return text
