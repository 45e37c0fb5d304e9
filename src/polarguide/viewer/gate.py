"""Who may talk to the viewer: a web page of a stranger's, open in the same browser, may not."""

from __future__ import annotations

import ipaddress
import re
from collections.abc import Iterable
from typing import Any
from urllib.parse import urlsplit

from polarguide.errors import PolarguideError

WEB = ("http", "https")
_PLACE = re.compile(r"(\[[^\[\]]*\]|[^\[\]:@]*)(:[0-9]*)?")
"""NAME or [ADDRESS], and :PORT."""
_NAME = re.compile(r"[\w-]+(\.[\w-]+)*")
"""No pattern: ``*`` is the name of nobody."""


class Gate:
    """Looks at the names in a request, never at ports, which tunnels change.

    Args:
        listening: the address that is listened at; where it is a name, requests may name it.
        hosts: further names under which the viewer may be asked for.
        origins: pages that may ask, as ``https://NAME`` or ``NAME``, besides those that the viewer itself sends.

    Raises:
        PolarguideError: a name is none.
    """

    def __init__(self, listening: str, hosts: Iterable[str] = (), origins: Iterable[str] = ()) -> None:
        self._hosts = {"localhost", listening.lower(), *(_given("allow_host", name) for name in hosts)}
        self._origins = {_given("allow_origin", name) for name in origins}

    def refusal(self, headers: Any) -> str | None:
        """Why a request with these headers (a ``websockets.Headers``) is refused, with the remedy; None: it is not.

        A name that is neither an address nor known here may be a stranger's that points to this machine (DNS
        rebinding); the origin is the page that asks, which other programs than browsers do not send.
        """
        named, asking = headers.get_all("Host"), headers.get_all("Origin")
        if len(named) != 1 or len(asking) > 1:
            return "One Host and at most one Origin are expected."
        host = host_of(f"//{named[0]}")
        if host is None or not (host in self._hosts or _is_address(host)):
            return (
                "This viewer is not known under this name. If it is yours, start it with --allow-host NAME."
            )
        if not asking:
            return None
        origin = host_of(asking[0], schemes=WEB)
        if origin is None or origin not in {host, *self._origins}:
            return "Pages of others may not look here. If it is yours, start the viewer with --allow-origin NAME."
        return None


def host_of(url: str, schemes: tuple[str, ...] = ("",)) -> str | None:
    """The host of SCHEME://HOST[:PORT] in lower case; None where it is something else, or has more to it."""
    try:
        parts = urlsplit(url)
        host, _ = parts.hostname, parts.port
    except ValueError:
        return None
    if _PLACE.fullmatch(parts.netloc) is None:  # urlsplit passes over what follows the bracket of an address
        return None
    more = parts.path.strip("/") or parts.query or parts.fragment or "@" in parts.netloc
    return host.rstrip(".") if host and parts.scheme in schemes and not more else None


def _given(option: str, name: str) -> str:
    """A name of the user's, as NAME or with its scheme."""
    host = host_of(name if "://" in name else f"//{name}", schemes=("", *WEB))
    if host is None or not (_is_address(host) or _NAME.fullmatch(host)):
        raise PolarguideError(
            option, expected="a name such as viewer.example.org", found=name, remedy="Give the name alone."
        )
    return host


def _is_address(host: str) -> bool:
    try:
        ipaddress.ip_address(host)
    except ValueError:
        return False
    return True
