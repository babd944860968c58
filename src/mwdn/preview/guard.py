"""What surrounds every request: who may ask, how much they may send, security headers, and one line in the log."""

import json
import time
from typing import Any
from urllib.parse import parse_qs

from starlette.datastructures import Headers, MutableHeaders
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import JSONResponse

from mwdn.errors import MwdnError
from mwdn.preview.as_fields import as_fields
from mwdn.preview.limits import LOG, Limits, RefusedError
from mwdn.preview.metrics import Metrics
from mwdn.preview.page_cookie import has_cookie, without_token_in_address
from mwdn.runtime.web_access import is_allowed

HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; "
    "img-src 'self' blob:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Permissions-Policy": "camera=(), microphone=(), geolocation=()",
    "Cache-Control": "no-store",
}

OPEN = ("/", "/healthz")
"""Paths that need no token, besides /static/: they hold nothing of the user's."""


class Guard:
    """Middleware around the application.

    Args:
        app: the application.
        limits: of the server.
        metrics: counts requests.
        token: secret that requests must know; empty if none is needed.
        any_host: see `is_allowed`.
    """

    def __init__(self, app: Any, limits: Limits, metrics: Metrics, *, token: str, any_host: bool) -> None:  # noqa: ANN401
        self.app, self.limits, self.metrics, self.token, self.any_host = app, limits, metrics, token, any_host

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:  # noqa: ANN401
        """Serve one request or WebSocket."""
        if scope["type"] == "lifespan":
            await self.app(scope, receive, send)
        elif scope["type"] == "websocket":
            await self._websocket(scope, receive, send)
        else:
            await self._http(scope, receive, send)

    def _may(self, scope: Any) -> bool:  # noqa: ANN401
        headers, path = Headers(scope=scope), scope["path"]
        scheme, _, given = headers.get("authorization", "").partition(" ")
        given = given if scheme.lower() == "bearer" else ""
        given = given or _token_in_address(scope)
        if path in OPEN or path.startswith("/static/") or (not given and has_cookie(scope, self.token)):
            given = self.token
        return is_allowed(headers, given, self.token, any_host=self.any_host)

    async def _websocket(self, scope: Any, receive: Any, send: Any) -> None:  # noqa: ANN401
        if self._may(scope):
            await self.app(scope, receive, send)
            return
        await receive()
        await send({"type": "websocket.close", "code": 1008})  # before it is accepted: status 403

    async def _http(self, scope: Any, receive: Any, send: Any) -> None:  # noqa: ANN401
        start, received, status = time.perf_counter(), 0, 0
        most = self.limits.upload_bytes

        async def counted() -> Any:  # noqa: ANN401
            nonlocal received
            message = await receive()
            received += len(message.get("body", b""))
            if received > most:
                raise _too_large(most)
            return message

        async def with_headers(message: Any) -> None:  # noqa: ANN401
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
                headers = MutableHeaders(scope=message)
                for name, value in HEADERS.items():
                    headers.setdefault(name, value)
            await send(message)

        try:
            refused = self._refusal(scope)
            app = self.app if refused is None else error_response(refused)
            if refused is None and self._is_page_with_token(scope):
                app = without_token_in_address(scope, self.token)
            await app(scope, counted, with_headers)
        finally:
            route = getattr(scope.get("route"), "path", "other")
            self.metrics.add("mwdn_requests_total", method=_verb(scope["method"]), route=route, status=str(status))
            self.metrics.add("mwdn_uploaded_bytes_total", received)
            ms = round(1000 * (time.perf_counter() - start), 1)
            log("request", method=_verb(scope["method"]), route=route, status=status, ms=ms, bytes=received)

    def _is_page_with_token(self, scope: Any) -> bool:  # noqa: ANN401
        given = _token_in_address(scope) if self.token and scope["path"] == "/" else ""
        return bool(given) and is_allowed(Headers(scope=scope), given, self.token, any_host=self.any_host)

    def _refusal(self, scope: Any) -> RefusedError | None:  # noqa: ANN401
        if not self._may(scope):
            if self.token:
                return RefusedError(
                    401,
                    "This server needs its token: the header `Authorization: Bearer TOKEN`. In a browser, open the "
                    "address that `mwdn preview` printed, and allow its cookie.",
                )
            return RefusedError(403, "Requests of other sites' pages are not served. Open the page by its own address.")
        length = Headers(scope=scope).get("content-length", "0")
        if length.isdigit() and int(length[:20]) > self.limits.upload_bytes:
            return _too_large(self.limits.upload_bytes)
        return None


def _token_in_address(scope: Any) -> str:  # noqa: ANN401
    return parse_qs(scope["query_string"].decode("latin-1")).get("token", [""])[0]


def _verb(method: str) -> str:
    """A method of HTTP: clients may send any word, which must not become a label each."""
    return method if method in ("GET", "HEAD", "POST", "DELETE") else "other"


def _too_large(most: int) -> RefusedError:
    return RefusedError(413, f"The request has more than {most:,} bytes, the server's limit. Crop or bin the frames.")


def error_response(error: Exception) -> JSONResponse:
    """An error as JSON: ``{"error": "..."}``."""
    status = error.status if isinstance(error, RefusedError) else 422
    headers = {401: {"WWW-Authenticate": "Bearer"}, 503: {"Retry-After": "2"}}.get(status)
    return JSONResponse({"error": as_fields(str(error))}, status, headers)


async def failed(_: Request, error: Exception) -> JSONResponse:
    """Any error of the application as JSON."""
    if isinstance(error, HTTPException):
        response = error_response(RefusedError(error.status_code, f"{error.detail}. See /openapi.json."))
        response.headers.update(error.headers or {})  # `Allow` of a path that has no such method
        return response
    if isinstance(error, MwdnError):
        return error_response(error)
    return error_response(RefusedError(500, "An error of mwdn itself. The server's log says more."))


def log(event: str, **values: Any) -> None:  # noqa: ANN401
    """One JSON object a line. Neither tokens nor file names are logged."""
    LOG.info(json.dumps({"time": round(time.time(), 3), "event": event, **values}))
