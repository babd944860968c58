"""The page's cookie: it replaces the token, which would stay in the address bar, the history and bookmarks."""

import hashlib
import hmac
from typing import Any

from starlette.requests import HTTPConnection
from starlette.responses import RedirectResponse, Response


def without_token_in_address(scope: Any, token: str) -> Response:  # noqa: ANN401
    """Send the browser to the page's address without the token, with a cookie that ends with the browser.

    Scripts cannot read the cookie, and pages of other sites cannot send it.
    """
    response = RedirectResponse("/", 303)
    is_encrypted = scope["scheme"] == "https"  # by a proxy
    response.set_cookie(_name(scope), _value(token), httponly=True, samesite="strict", secure=is_encrypted)
    return response


def has_cookie(scope: Any, token: str) -> bool:  # noqa: ANN401
    """Whether a request or WebSocket has the cookie of this token."""
    given = HTTPConnection(scope).cookies.get(_name(scope), "")
    return hmac.compare_digest(given.encode(), _value(token).encode())


def _name(scope: Any) -> str:  # noqa: ANN401
    """All ports of a host share its cookies, so that two servers need two names."""
    return f"mwdn-preview-{scope['server'][1]}"


def _value(token: str) -> str:
    """Derived from the token: browsers send the cookie to other servers on this host, too, which must not learn it."""
    return hmac.new(token.encode(), b"cookie of the page of mwdn preview", hashlib.sha256).hexdigest()
