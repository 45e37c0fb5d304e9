"""Variables of the environment that would end the process, or keep it busy for ever."""

from __future__ import annotations

import pytest

from polarguide.errors import PolarguideError
from polarguide.variables import check_variables


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("POLARGUIDE_THREADS", "1000000000"),
        ("POLARGUIDE_THREADS", "1025"),
        ("OPENCV_IO_MAX_IMAGE_PIXELS", "many"),
        ("OPENCV_IO_MAX_IMAGE_WIDTH", "-1"),
        ("OPENCV_IO_MAX_IMAGE_HEIGHT", "1e6"),
        ("OPENCV_IMGCODECS_WEBP_MAX_FILE_SIZE", "64 MB"),
    ],
)
def test_refused(monkeypatch: pytest.MonkeyPatch, name: str, value: str) -> None:
    monkeypatch.setenv(name, value)
    with pytest.raises(PolarguideError, match=f"the variable {name}: expected"):
        check_variables()


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("POLARGUIDE_THREADS", "1024"),
        ("POLARGUIDE_THREADS", "many"),  # passed over
        ("OPENCV_IO_MAX_IMAGE_PIXELS", "1099511627776"),
        ("OPENCV_IO_MAX_IMAGE_PIXELS", "64MB"),
        ("OPENCV_LOG_LEVEL", "SILENT"),
    ],
)
def test_taken(monkeypatch: pytest.MonkeyPatch, name: str, value: str) -> None:
    monkeypatch.setenv(name, value)
    check_variables()
