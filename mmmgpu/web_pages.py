"""What the pages of `mmmgpu mark` and `mmmgpu study` share: strict headers, and this computer.

Neither page loads anything from elsewhere, is kept by a browser, says where it was, or can be put
into the frame of another one. Nothing here listens or answers: `mmmgpu.marking_server` and
`mmmgpu.study_server` do.
"""

import ipaddress
import socket
from collections.abc import Mapping

LOOPBACK = str(ipaddress.IPv4Address(socket.INADDR_LOOPBACK))  # this computer alone
_REFUSED = {"base-uri": "'none'", "form-action": "'none'", "frame-ancestors": "'none'"}


def strict_headers(sources: Mapping[str, str]) -> dict[str, str]:
    """Headers for every answer of a server whose page may load nothing but `sources`.

    sources: directives of the Content-Security-Policy, as {"script-src": "'self'"}.
    """
    policy = {"default-src": "'none'", **sources, **_REFUSED}
    return {
        "Cache-Control": "no-store",
        "Content-Security-Policy": "; ".join(f"{name} {value}" for name, value in policy.items()),
        "Cross-Origin-Resource-Policy": "same-origin",
        "Referrer-Policy": "no-referrer",
        "X-Content-Type-Options": "nosniff",
    }
