"""Variables of the environment that would end the process, or keep it busy for ever, without a word."""

from __future__ import annotations

import os
import re

from polarguide.errors import PolarguideError
from polarguide.options import MOST_THREADS

_SIZE = re.compile(r"[0-9]{1,18}(KB|Kb|kb|MB|Mb|mb)?")
_SIZES = re.compile(r"OPENCV_(IO_MAX_IMAGE_[A-Z]+|IMGCODECS_[A-Z]+_MAX_FILE_SIZE)")
"""Read by OpenCV as it is loaded, which ends the process where one is no size."""


def check_variables() -> None:
    """Check what is read before anything can say what is wrong with it.

    Raises:
        PolarguideError: the kernels would start more threads than any machine has, or OpenCV would end the process.
    """
    threads = os.environ.get("POLARGUIDE_THREADS", "").strip()
    if threads.isdecimal() and len(threads) < 1000 and int(threads) > MOST_THREADS:
        raise _wrong("POLARGUIDE_THREADS", f"a number up to {MOST_THREADS}", threads)
    for name, text in os.environ.items():
        if _SIZES.fullmatch(name) and not _SIZE.fullmatch(text):
            raise _wrong(name, "a whole number", text)


def _wrong(name: str, expected: str, found: str) -> PolarguideError:
    return PolarguideError(
        f"the variable {name}",
        expected=expected,
        found=repr(found[:100]),
        remedy=f"Correct it, or unset {name}.",
    )
