"""Preparations that end in a message."""

from __future__ import annotations

from pathlib import Path

import pytest

from polarguide.capture import load_scene
from polarguide.core.errors import PolarguideError
from polarguide.preparation.prepare import prepare_scene
from polarguide.preparation.settings import PrepareSettings

MOSAIC = PrepareSettings(sensor="IMX250MYR", poses="none")
NAMES = ("v000", "v001", "v002")
FILTER = PrepareSettings(poses="none", align=False)


def refused(source: Path, out: Path, settings: PrepareSettings) -> str:
    """The message of a refusal, after which there is no scene that could be trained on."""
    with pytest.raises(PolarguideError) as error:
        prepare_scene(source, out, settings)
    assert not (out / "scene.json").exists()
    assert not (out / "sparse").exists()
    if (out / "polar").exists():
        with pytest.raises(PolarguideError):
            load_scene(out)
    text = str(error.value)
    assert "\n" not in text
    assert text.endswith(".")
    return text
