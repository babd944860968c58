"""Limits of what a client may ask for, each named in the error of a request that exceeds it; errors for clients."""

import logging
from dataclasses import dataclass

from mwdn.errors import MwdnError, ParameterError, PluginError

LOG = logging.getLogger("mwdn.preview")


@dataclass(frozen=True, kw_only=True)
class Limits:
    """Limits of the server.

    Args:
        upload_bytes: of a request: the capture and the PSF together.
        frame_pixels: of an uploaded frame, before it is cropped and binned.
        pixels: of a measurement, which decide about memory and time.
        seconds: for a reconstruction, without the time it waits; solvers end after the iteration in progress.
        upload_s: for a request to arrive.
        at_once: reconstructions at the same time.
        waiting: requests that wait for their turn.
        waiting_bytes: of their uploads.
        result_bytes: of all results that are kept for download; the oldest are forgotten first.
        cameras: stored calibrations.
        viewers: of the live picture.

    Raises:
        ParameterError: a number is not positive.
    """

    upload_bytes: int = 2**25
    frame_pixels: int = 2**24
    pixels: int = 2**20
    seconds: float = 120.0
    upload_s: float = 30.0
    at_once: int = 1
    waiting: int = 256
    waiting_bytes: int = 2**29
    result_bytes: int = 2**28
    cameras: int = 100
    viewers: int = 100

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not value > 0:
                raise ParameterError(f"`{name}` ({value}) of the limits must be positive.")


class RefusedError(MwdnError):
    """A request that is not served.

    Args:
        status: of HTTP.
        message: what must hold, and the way out.
    """

    def __init__(self, status: int, message: str) -> None:
        super().__init__(message)
        self.status = status


def for_client(error: BaseException, work: str) -> MwdnError:
    """The error that a client is told. One that is not the client's fault is logged and becomes a `RefusedError` 500.

    Args:
        error: that ended the work; a plugin's, or a defect of this package, is not the client's fault.
        work: that it ended, for the log.
    """
    if isinstance(error, MwdnError) and not isinstance(error, PluginError):
        return error
    LOG.error(work, exc_info=error)
    own = f"An error of mwdn itself: {type(error).__name__}. The server's log says more."
    return RefusedError(500, str(error) if isinstance(error, PluginError) else own)
