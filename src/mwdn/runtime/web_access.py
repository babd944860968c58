"""Access control of the pages of this package: this computer, and requests with the page's token."""

import hmac
import socket
from collections.abc import Mapping
from urllib.parse import quote, urlsplit

from mwdn.errors import ParameterError, reason

LOOPBACK = ("127.0.0.1", "localhost", "::1")
"""Addresses that other computers cannot reach; all others need a token."""


def check_token(host: str, token: str) -> None:
    """Check that an address which other computers can reach has a token, and that a header can hold it.

    Raises:
        ParameterError: it has none, or one of other characters than printable ASCII.
    """
    if not (token.isascii() and token.isprintable()):
        raise ParameterError("`token` must be of ASCII letters, digits and signs: a header holds no others.")
    if host not in LOOPBACK and not token:
        raise ParameterError(f"`host` ({host}) can be reached by other computers: it needs a `token`, a secret.")


def is_allowed(headers: Mapping[str, str], given: str, token: str, *, any_host: bool) -> bool:
    """Whether a request may be answered.

    The token must be right. The request must not come from a page of another site (Origin), nor from one whose name
    resolves to this computer (Host; DNS rebinding).

    Args:
        headers: of the request, by lower-case names.
        given: token of the request; empty if it has none.
        token: the right one; empty if none is needed.
        any_host: the server may be called by any name, because it needs a token.
    """
    host, origin = headers.get("host", ""), headers.get("origin", "")
    try:
        name, other = urlsplit(f"//{host}").hostname or "", urlsplit(origin).netloc
    except ValueError:  # an unclosed bracket
        return False
    is_own = (not origin or other == host) and (any_host or name in LOOPBACK)
    return is_own and hmac.compare_digest(given.encode(), token.encode())


def listen(host: str, port: int) -> socket.socket:
    """A listening socket.

    Args:
        host: address of this computer.
        port: 0 for a free one.

    Raises:
        ParameterError: the address is in use, or not of this computer.
    """
    listener = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET, socket.SOCK_STREAM)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((host, port))
        listener.listen()  # before the server starts, so that early requests wait
    except (OSError, OverflowError) as error:
        listener.close()
        raise ParameterError(f"`host` and `port` ({host}:{port}) cannot be used: {reason(error)}.") from error
    return listener


def page_url(host: str, listener: socket.socket, token: str) -> str:
    """The address of a page, with its token if it needs one.

    Args:
        host: address of this computer, as for `listen`.
        listener: its listening socket: it knows the port.
        token: empty if none is needed.
    """
    address = f"[{host}]" if ":" in host else host
    query = f"?token={quote(token)}" if token else ""
    return f"http://{address}:{listener.getsockname()[1]}/{query}"
