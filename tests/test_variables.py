"""Variables of the environment that would end the process, or keep it busy for ever."""

from __future__ import annotations

import pytest

from polarguide.errors import PolarguideError
from polarguide.variables import check_variables


@pytest.mark.parametrize(
    ("name", "value", "refused"),
    [
        ("POLARGUIDE_THREADS", "1000000000", True),
        ("POLARGUIDE_THREADS", "1025", True),
        ("POLARGUIDE_THREADS", "1024", False),
        ("POLARGUIDE_THREADS", "many", False),  # passed over
        ("OPENCV_IO_MAX_IMAGE_PIXELS", "many", True),
        ("OPENCV_IO_MAX_IMAGE_PIXELS", "1099511627776", False),
        ("OPENCV_IO_MAX_IMAGE_PIXELS", "64MB", False),
        ("OPENCV_IO_MAX_IMAGE_WIDTH", "-1", True),
        ("OPENCV_IO_MAX_IMAGE_HEIGHT", "1e6", True),
        ("OPENCV_IMGCODECS_WEBP_MAX_FILE_SIZE", "64 MB", True),
        ("OPENCV_LOG_LEVEL", "SILENT", False),
    ],
)
def test_what_would_end_the_process_is_refused(
    monkeypatch: pytest.MonkeyPatch, name: str, value: str, refused: bool
) -> None:
    monkeypatch.setenv(name, value)
    try:
        check_variables()
        found = None
    except PolarguideError as error:
        found = error.where
    assert found == (f"the variable {name}" if refused else None)
