"""One route for all methods of a path, so that the answer to any other names them."""

from collections.abc import Awaitable, Callable

from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

Handler = Callable[[Request], Awaitable[Response]]


def route(path: str, **handlers: Handler) -> Route:
    """``route("/jobs/{id}", GET=show, DELETE=cancel)``: HEAD is answered as GET, without a body.

    Args:
        path: of the route.
        **handlers: by the method of HTTP.
    """

    async def answer(request: Request) -> Response:
        return await handlers["GET" if request.method == "HEAD" else request.method](request)

    return Route(path, answer, methods=[*handlers])
