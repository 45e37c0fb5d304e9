"""Which names a request to the viewer may bear."""

from __future__ import annotations

import pytest
from websockets.datastructures import Headers

from polarguide.errors import PolarguideError
from polarguide.viewer.gate import Gate

OWN = Gate("127.0.0.1", ["tunnel.example.org"], ["https://hub.example.org"])


@pytest.mark.parametrize(
    "host",
    ["127.0.0.1:8080", "localhost:9", "LOCALHOST.", "[::1]:80", "192.168.1.7", "tunnel.example.org:443"],
)
def test_names_of_this_machine_pass_with_pages_of_their_own_or_none(host: str) -> None:
    assert OWN.refusal(Headers(Host=host)) is None
    name = host.rpartition(":")[0] if not host.endswith((".", "]")) and ":" in host else host
    for origin in (f"http://{name}", f"https://{name}:1234", "https://hub.example.org:8443"):
        assert OWN.refusal(Headers(Host=host, Origin=origin)) is None, origin


@pytest.mark.parametrize(
    "host",
    ["evil.example", "127.0.0.1.evil.example", "localhost.evil.example:8080", "", "a b", "[::1", "me@127.0.0.1",
     "127.0.0.1/x", "127.0.0.1:port", "0x7f.1", "[::1].evil.example", "[::1]evil.example:80"],
)  # fmt: skip
def test_other_names_are_refused_with_the_remedy(host: str) -> None:
    assert "--allow-host" in (OWN.refusal(Headers(Host=host)) or "")


@pytest.mark.parametrize(
    "origin",
    ["https://evil.example", "null", "", "file://", "http://127.0.0.1.evil.example", "https://localhost", "http://",
     "chrome-extension://127.0.0.1", "http://127.0.0.1@evil.example", "http://evil.example/127.0.0.1"],
)  # fmt: skip
def test_other_pages_are_refused_with_the_remedy(origin: str) -> None:
    assert "--allow-origin" in (OWN.refusal(Headers(Host="127.0.0.1:8080", Origin=origin)) or "")


def test_a_request_without_a_name_or_with_two_is_refused() -> None:
    twice = Headers([("Host", "127.0.0.1"), ("Host", "127.0.0.1")])
    assert OWN.refusal(Headers()) is not None
    assert OWN.refusal(twice) is not None
    two = Headers([("Host", "localhost"), ("Origin", "http://localhost"), ("Origin", "http://evil.example")])
    assert OWN.refusal(two) is not None


def test_the_name_that_is_listened_at_passes() -> None:
    assert Gate("workstation.lan").refusal(Headers(Host="workstation.lan:8080")) is None


def test_a_name_that_is_none_is_refused() -> None:
    for given in ({"hosts": ["a/b"]}, {"origins": ["ftp://x"]}, {"hosts": [""]}):
        with pytest.raises(PolarguideError, match="a name such as"):
            Gate("127.0.0.1", **given)


@pytest.mark.parametrize("name", ["*", "*.example.org", "a b", "a,b", "tunnel..org", "<b>"])
def test_a_pattern_is_no_name(name: str) -> None:
    with pytest.raises(PolarguideError, match="expected a name such as"):
        Gate("127.0.0.1", [name])
