"""Serves the application until it is stopped."""

import logging
import socket
import sys
import threading
from typing import Any

from mwdn.preview.limits import Limits
from mwdn.runtime.requirement import require
from mwdn.runtime.web_access import LOOPBACK, check_token, listen, page_url

CONNECTIONS = 512
"""Connections at the same time; others get the status 503 at once."""

STOP_S = 10
"""Seconds that requests in progress have when the server is stopped."""


class PreviewServer:
    """The server of one `Preview`. Its socket listens from the start.

    Args:
        preview: `mwdn.preview.application.Preview`.
        host: address of this computer; others than `LOOPBACK` need a token.
        port: 0 for a free one.
        token: secret that requests must know.

    Raises:
        MissingPackageError: the extra is not installed.
        ParameterError: no token where one is needed, or the address cannot be used.
    """

    def __init__(self, preview: Any, *, host: str = "127.0.0.1", port: int = 0, token: str = "") -> None:  # noqa: ANN401
        check_token(host, token)
        import uvicorn

        self.socket: socket.socket = listen(host, port)
        self.url = page_url(host, self.socket, token)
        config = uvicorn.Config(
            preview.app(token=token, any_host=host not in LOOPBACK),
            ws="websockets-sansio",
            ws_max_size=4096,
            ws_per_message_deflate=False,  # the pictures are JPEGs: deflating them again takes time and gains nothing
            http="h11",
            access_log=False,
            log_config=None,
            lifespan="on",
            limit_concurrency=CONNECTIONS,
            timeout_keep_alive=5,
            timeout_graceful_shutdown=STOP_S,
            server_header=False,
        )
        self._server = uvicorn.Server(config)
        self._cancel = preview.jobs.close
        usual_exit = self._server.handle_exit

        def exit_at_once(sig: int, frame: Any) -> None:  # noqa: ANN401
            """Requests in progress end when their jobs are cancelled; by itself uvicorn waits for them first."""
            threading.Thread(target=self._cancel, daemon=True).start()
            usual_exit(sig, frame)

        self._server.handle_exit = exit_at_once  # type: ignore[method-assign]
        self._thread: threading.Thread | None = None

    def run(self) -> None:
        """Serve until Ctrl-C or SIGTERM, which cancel reconstructions in progress."""
        self._server.run([self.socket])

    def start(self) -> None:
        """Serve in a thread, for tests and notebooks; `stop` ends it."""
        self._thread = threading.Thread(target=self.run, daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Cancel reconstructions in progress, and stop."""
        self._server.should_exit = True
        self._cancel()
        if self._thread is not None:
            self._thread.join(timeout=2 * STOP_S)
        self.socket.close()


def make_server(
    cameras: Any,  # noqa: ANN401
    limits: Limits = Limits(),
    *,
    host: str = "127.0.0.1",
    port: int = 0,
    token: str = "",
    device: str | None = None,
    live: Any = None,  # noqa: ANN401
) -> PreviewServer:
    """A server with its application.

    Args:
        cameras: `mwdn.preview.cameras.StoredCameras`.
        limits: of the server.
        host: see `PreviewServer`.
        port: likewise.
        token: likewise.
        device: of the reconstructions.
        live: `mwdn.preview.live.Live`.

    Raises:
        ParameterError: as for `PreviewServer`.
    """
    application = require("mwdn.preview.application", "page", purpose="The page")
    return PreviewServer(
        application.Preview(cameras, limits, device=device, live=live), host=host, port=port, token=token
    )


def log_to_stderr() -> None:
    """Write the log of the server, one JSON object a line, to standard error."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(logging.Formatter("%(message)s"))
    logger = logging.getLogger("mwdn.preview")
    logger.addHandler(handler)
    logger.setLevel(logging.INFO)
    logger.propagate = False
